"""A disc that rests on a floor under its own weight: the pressure of contact, against that of Hertz.

The disc comes to rest by damping. The pressure is the force on each point of its surface over the length that the point
stands for, which contact has shortened. One of Hertz, p sqrt(1 - (x / a)^2), is fitted to it. The updated frame has no
such points.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from benchmarks.convergence.hertz import LineContact
from benchmarks.convergence.points import Measured, NoReference, Point, Test
from benchmarks.convergence.worlds import YOUNGS_MODULUS, Matter, Nodes, observe_nodes, scene_of, with_time
from cqrun.plugin.contract import Array
from cqrun.state import State

RADIUS = 0.03
"""R [m]; the cells of a point are those in it."""

GRAVITY = 160.0
"""[m/s^2]: the half-width of the contact becomes a quarter of R."""

DAMPING, SECONDS = 60.0, 0.6
"""Damping rate [1/s], and the time after which the disc is at rest."""


def measure(point: Point) -> Measured:
    """Let the disc come to rest, and compare its contact."""
    if point.dim != 2:
        raise NoReference("the disc is a test in 2D alone")
    dx = RADIUS / point.cells
    side = RADIUS + 3.0 * dx
    size = [float(np.ceil(edge / dx - 1e-9) * dx) for edge in (2.0 * side, 2.0 * RADIUS + 4.0 * dx)]
    data = scene_of(
        point, {"ball": {"center": [0.5 * size[0], RADIUS], "radius": RADIUS}},
        {"size": size, "dx": dx, "gravity": [0.0, -GRAVITY]},
        boundaries={"floor": {"separate": {"face": "y_min"}}}, loads={"air": {"damping": {"rate": DAMPING}}},
    )  # fmt: skip
    built = with_time(data, point, SECONDS / 20, 20)
    matter, surface = Matter.of(built, point), built.model.surface
    assert surface is not None
    stiffness = surface.stiffness

    def see(state: State, nodes: Nodes | None) -> Array:
        assert nodes is not None
        x = nodes.surface - matter.centre(state.x)
        force = stiffness * np.maximum(-nodes.surface[:, -1], 0.0)
        return np.stack([*x.T, force, share_of(nodes.surface, surface.facets), speed_of(state)])

    def speed_of(state: State) -> Array:
        return np.full(len(stiffness), abs(matter.centre(state.v)[-1]))

    x, z, force, length, speed = observe_nodes(built, see)[-1]
    lower = z < 0.0
    weight = GRAVITY * float(matter.mass.sum())
    right = LineContact(RADIUS, YOUNGS_MODULUS, point.poissons_ratio, weight)
    peak, half_width = fit_pressure(x[lower], force[lower], length[lower], right)
    return {
        "peak_pressure": peak / right.peak_pressure, "half_width": half_width / right.half_width,
        "force": force.sum() / weight, "speed": speed[0],
    }  # fmt: skip


def share_of(x: Array, segments: Array) -> Array:
    """Return the length of the surface (S,) [m] that each point at x (S, 2) stands for: half of its segments."""
    half, share = 0.5 * np.linalg.norm(x[segments[:, 1]] - x[segments[:, 0]], axis=1), np.zeros(len(x))
    for end in segments.T:
        np.add.at(share, end, half)
    return share


def fit_pressure(x: Array, force: Array, length: Array, guess: LineContact) -> tuple[float, float]:
    """Return the peak [Pa] and the half-width [m] of the Hertzian pressure that fits best.

    Args:
        x: places of points on the lower half, from its middle [m].
        force, length: on each, and of its part of the surface, over which the pressure is fitted evenly.
    """
    near = (np.abs(x) < 2.0 * guess.half_width) & (length > 0.0)

    weight, measured = np.sqrt(length[near]), force[near] / length[near] / guess.peak_pressure

    def rest(q: Array) -> Array:
        right = np.sqrt(np.maximum(1.0 - (x[near] / (q[1] * guess.half_width)) ** 2, 0.0))
        return np.asarray(weight * (q[0] * right - measured))

    found = least_squares(rest, [1.0, 1.0], bounds=([0.1, 0.1], [10.0, 3.0]))
    return float(found.x[0] * guess.peak_pressure), float(found.x[1] * guess.half_width)


TEST = Test(
    name="hertz",
    summary=f"disc of radius 3 cm at rest on a floor, {GRAVITY:g} m/s^2",
    columns={
        "peak_pressure": "largest pressure over that of Hertz",
        "half_width": "half-width of the contact over that of Hertz",
        "force": "of all points of contact, over the weight",
        "speed": "speed at the end [m/s]",
    },
    ideal={"peak_pressure": 1.0, "half_width": 1.0, "force": 1.0, "speed": 0.0},
    variants=(("fixed_corotated", 0.3, "", 1), ("fixed_corotated", 0.45, "", 1)),
    measure=measure,
    reference_only=("",),
    hidden=("speed",),
)
