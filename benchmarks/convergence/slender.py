"""A slender cantilever at rest under a dead load at its end: the elastica, and the column above its buckling load.

The beam is 20 times as long as high. So the theory of the thin inextensible beam (elastica.py) holds to about 0.5 %.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import brentq

from benchmarks.convergence.elastica import column, elastica, euler_load, plate_stiffness
from benchmarks.convergence.points import Measured, Point, Test
from benchmarks.convergence.rests import last_rest
from benchmarks.convergence.worlds import PER_AXIS, YOUNGS_MODULUS, Block, Matter, scene, with_time
from cqrun.plugin.contract import Array

LENGTH, HEIGHT = 0.2, 0.01
"""From the clamp to the load, and the height [m]; in 3D the width is the height."""

BUCKLING = 1.1
"""Load of the column over its Euler load."""

ASIDE = 0.05
"""Load across the column, over that along it, which chooses the side; the last points of the path have none."""


def bending_stiffness(point: Point) -> float:
    """Return EI [N m^2; in 2D N m per width]."""
    if point.dim == 2:
        return plate_stiffness(YOUNGS_MODULUS, point.poissons_ratio, HEIGHT)
    return YOUNGS_MODULUS * HEIGHT**4 / 12.0


def end_displacement(point: Point, force: tuple[float, float], path: dict[str, Any]) -> Array:
    """Return the displacement of the loaded end along and across the beam, over its length.

    The load acts on the last column of particles, whose centres are at `LENGTH` from the wall.

    Args:
        force: along and across [N; in 2D N/m].
        path: of the load's components.
    """
    dim, dx = point.dim, HEIGHT / point.cells
    spacing = dx / PER_AXIS
    inside = (np.ceil((LENGTH + 2.0 * dx) / spacing) + 0.5) * spacing - LENGTH
    size = (inside + LENGTH + 0.5 * spacing, *[HEIGHT] * (dim - 1))
    wall = 4.0 * dx
    block = Block((wall - inside, *[4.0 * dx] * (dim - 1)), size)
    span = [wall + np.ceil(LENGTH / dx) * dx + 4.0 * dx, *[HEIGHT + 8.0 * dx] * (dim - 1)]
    clamp = {"sticky": {"region": {"box": {"corner": [0.0] * dim, "size": [wall, *span[1:]]}}}}
    end = {"box": {"corner": [wall + LENGTH - 0.25 * spacing, *[0.0] * (dim - 1)], "size": [spacing, *span[1:]]}}
    load = {"body": "block", "region": end, "force": [force[0], *[0.0] * (dim - 2), force[1]]}
    data = scene(
        point, block, {"size": span, "dx": dx}, boundaries={"clamp": clamp}, loads={"end": {"point_force": load}},
        path=path,
    )  # fmt: skip
    built = with_time(data, point, 1.0, 1)
    matter = Matter.of(built, point)
    loaded = matter.X[:, 0] > wall + LENGTH - 0.25 * spacing
    if not np.allclose(matter.X[loaded, 0], wall + LENGTH):
        raise ValueError("the load is not at the end")
    moved = last_rest(built).state.x - matter.X
    return np.asarray(moved[loaded].mean(0)[[0, -1]] / LENGTH)


def bend(point: Point) -> Measured:
    """Bend the beam by a load across it, P L^2 / EI = the number in the case."""
    load = float(point.case.removeprefix("load "))
    force = load * bending_stiffness(point) / LENGTH**2
    along, across = end_displacement(point, (0.0, force), {})
    right = elastica(load)
    return {"across": across / right.across, "along": along / right.along}


def buckle(point: Point) -> Measured:
    """Compress the column beyond its Euler load, and find the Euler load to which the answer belongs."""
    force = BUCKLING * euler_load(bending_stiffness(point), LENGTH)
    key = "loads.end.point_force.force"
    path = {f"{key}.0": [-force] * 4, f"{key}.{point.dim - 1}": [part * ASIDE * force for part in (1.0, 0.5, 0.1, 0.0)]}
    along, across = end_displacement(point, (-force, 0.0), path)
    right = column(BUCKLING)
    found = np.nan
    if along < 2.0 * (column(1.001).along):
        found = BUCKLING / float(brentq(lambda ratio: column(ratio).along - along, 1.001, 3.0))
    return {"across": abs(across) / right.across, "euler_load": found}


ELASTICA = Test(
    name="elastica",
    summary="beam 20 x 1 cm at rest under a load P at its end",
    columns={
        "across": "displacement of the end across over theory",
        "along": "displacement of the end along over theory",
    },
    ideal={"across": 1.0, "along": 1.0},
    variants=(
        ("fixed_corotated", 0.3, "load 3", 1), ("fixed_corotated", 0.3, "load 10", 1),
        ("fixed_corotated", 0.499, "load 3", 1), ("neo_hookean", 0.3, "load 3", 1),
    ),
    measure=bend,
    reference_only=("load 3", "load 10"),
)  # fmt: skip

COLUMN = Test(
    name="column",
    summary=f"column 20 x 1 cm at rest under {BUCKLING:g} times its Euler load",
    columns={
        "across": "displacement of the end across over theory",
        "euler_load": "Euler load that fits the displacement, over theory",
    },
    ideal={"across": 1.0, "euler_load": 1.0},
    variants=(("fixed_corotated", 0.3, "", 1), ("fixed_corotated", 0.499, "", 1), ("neo_hookean", 0.3, "", 1)),
    measure=buckle,
    reference_only=("",),
)
