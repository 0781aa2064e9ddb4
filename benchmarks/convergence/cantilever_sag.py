"""The cantilever at rest: 10 x 3 (x 3) cm under 1 g and 10 g, against the finite-element references."""

from __future__ import annotations

from benchmarks.convergence.cantilever_swing import beam_scene, tip_weights
from benchmarks.convergence.points import Measured, NoReference, Point, Test, references
from benchmarks.convergence.rests import last_rest
from benchmarks.convergence.worlds import Matter, with_time

GRAVITIES = {"1 g": ("sag_1g", 1.0), "10 g": ("sag_10g", 10.0)}
"""Name of the reference, and gravity in units of the standard one, by case."""


def measure(point: Point) -> Measured:
    """Find the equilibrium and compare the mean displacement of the end face."""
    name, gravities = GRAVITIES[point.case]
    name = f"{point.dim}D {point.law} nu {point.poissons_ratio:g} {name}"
    if name not in references()["references"]:
        raise NoReference(f"references.json has no {name}")
    right = references()["references"][name]
    built = with_time(beam_scene(point, gravities), point, 1.0, 1)
    matter = Matter.of(built, point)
    rest = last_rest(built)
    tip = tip_weights(matter) @ (rest.state.x - matter.X)
    return {
        "sag": tip[-1] / right["mean_up"], "towards_clamp": tip[0] / right["mean_along"], "products": rest.products,
    }  # fmt: skip


TEST = Test(
    name="sag",
    summary="cantilever 10 x 3 cm at rest under 1 g and 10 g",
    columns={
        "sag": "displacement of the tip downwards over the reference",
        "towards_clamp": "displacement of the tip towards the clamp, as well",
        "products": "products with the stiffness matrix",
    },
    ideal={"sag": 1.0, "towards_clamp": 1.0},
    variants=(
        *(("fixed_corotated", nu, "1 g", 1) for nu in (0.3, 0.45, 0.49, 0.499)),
        *(("fixed_corotated", nu, "10 g", 1) for nu in (0.3, 0.45, 0.49, 0.499)),
        *(("neo_hookean", 0.45, case, 1) for case in GRAVITIES),
    ),
    measure=measure,
    reference_only=tuple(GRAVITIES),
    hidden=("products",),
)
