"""The swinging cantilever: 10 x 3 (x 3) cm, let go under 1 g, against the finite-element references."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.convergence.oscillation import fit_oscillation
from benchmarks.convergence.points import Measured, Point, Test, references
from benchmarks.convergence.worlds import PER_AXIS, Block, Matter, observe, scene, with_time
from cqrun.build.model import Built
from cqrun.plugin.contract import Array
from cqrun.state import State

PERIODS, FRAMES_A_PERIOD = 10, 40


def reference(point: Point) -> tuple[float, float]:
    """Return the frequency [Hz] and the mean height of the tip [m] of the swing.

    They are those of the small vibration and of the rest, times the factors of a swing as large as this one; the
    factors of 3D are those of 2D where 3D ones are missing.
    """
    found = references()["references"]
    of = f"{point.dim}D {{}} nu {point.poissons_ratio:g} {{}}"
    frequency = found[of.format("fixed_corotated", "frequency")]["frequency"]
    rest = found[of.format(point.law, "sag_1g")]["mean_up"]
    swing = of.format(point.law, "swing_1g")
    factors = found.get(swing) or found[swing.replace("3D", "2D")]
    return frequency * factors["frequency"], rest * factors["mean_up"]


def beam_scene(point: Point, gravities: float = 1.0) -> dict[str, Any]:
    """Return the scene without its time.

    The clamp holds the nodes up to a wall at a node; the beam continues 2 cells or more into it.
    """
    beam = references()["beam"]
    length, height, dim = beam["length"], beam["height"], point.dim
    dx = height / point.cells
    spacing = dx / PER_AXIS
    inside = np.ceil((length + 2.0 * dx) / spacing) * spacing - length  # so that the tip is a face of the lattice
    wall, room = 4.0 * dx, np.ceil(0.5 * length / dx) * dx
    across = [4.0 * dx] * (dim - 2)
    corner = (wall - inside, *across, room)
    size = (inside + length, *[beam["width"]] * (dim - 2), height)
    span = [wall + np.ceil(length / dx) * dx + 4.0 * dx, *[beam["width"] + 8.0 * dx] * (dim - 2), room + height + room]
    world = {"size": span, "dx": dx, "gravity": [0.0] * (dim - 1) + [-gravities * beam["gravity"]]}
    clamp = {"sticky": {"region": {"box": {"corner": [0.0] * dim, "size": [wall, *span[1:]]}}}}
    return scene(point, Block(corner, size), world, boundaries={"clamp": clamp})


def build_swing(point: Point) -> Built:
    """Build the scene of the swing."""
    frequency = reference(point)[0]
    return with_time(beam_scene(point), point, 1.0 / (FRAMES_A_PERIOD * frequency), PERIODS * FRAMES_A_PERIOD)


def tip_weights(matter: Matter) -> Array:
    """Return weights (N,) of the particles that give the mean over the end face: the last two columns, extrapolated."""
    depth = (matter.X[:, 0].max() - matter.X[:, 0]) / matter.spacing
    last, before = depth < 0.5, (depth > 0.5) & (depth < 1.5)
    return np.asarray(1.5 * last / last.sum() - 0.5 * before / before.sum())


def measure(point: Point) -> Measured:
    """Run the swing and compare it."""
    built = build_swing(point)
    matter = Matter.of(built, point)
    weights = tip_weights(matter)

    def height(state: State) -> float:
        return float(weights @ (state.x[:, -1] - matter.X[:, -1]))

    heights = observe(built, height)
    frequency, mean = reference(point)
    time = built.scene.time.control_step * np.arange(len(heights))
    found = fit_oscillation(time, heights, frequency)
    return {
        "frequency_ratio": found.frequency / frequency, "mean_tip_ratio": found.mean / mean,
        "damping_ratio": found.damping_ratio, "misfit": found.residual,
    }  # fmt: skip


TEST = Test(
    name="swing",
    summary=f"cantilever 10 x 3 cm let go under 1 g, {PERIODS} periods",
    columns={
        "frequency_ratio": "over the finite-element reference",
        "mean_tip_ratio": "mean height of the tip over the reference",
        "damping_ratio": "numerical damping over critical damping",
        "misfit": "rest of the damped sine over its amplitude",
    },
    ideal={"frequency_ratio": 1.0, "mean_tip_ratio": 1.0, "damping_ratio": 0.0},
    variants=(
        *(("fixed_corotated", nu, "", factor) for nu in (0.3, 0.45) for factor in (1, 4, 16)),
        *(("fixed_corotated", nu, "", 1) for nu in (0.49, 0.499)),
        ("neo_hookean", 0.45, "", 1),
    ),
    measure=measure,
    decades=("damping_ratio",),
    hidden=("misfit",),
)
