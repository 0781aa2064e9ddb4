"""A block and a floor: dropped, at rest, and on an incline with friction."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.convergence.points import Measured, Point, Test
from benchmarks.convergence.worlds import Block, Matter, Nodes, observe, observe_nodes, scene, with_time
from cqrun.build.model import Built
from cqrun.plugin.contract import Array
from cqrun.state import State

SIDE, GRAVITY = 0.03, 9.81
DROP = 0.05
"""Height of the fall [m]: about 1 m/s at the floor, 6 % of the speed of sound."""

ANGLE = 0.35
FRICTION = {"slides": 0.2, "sticks": 0.5}
"""Friction coefficients on an incline of tan(0.35) = 0.365."""

DEFAULT_DASHPOT = "default dashpot"
"""The case of the reference frame in which contact has the damping of the default; the other case has none."""

REST_DAMPING = 20.0
"""Damping rate [1/s] that brings a block to rest on the floor; it holds up no weight."""


def _block_on_floor(
    point: Point, gap: float, floor: dict[str, Any], seconds: float, frames: int, run_out: float = 0.0,
    angle: float = 0.0, **sections: Any,
) -> Built:  # fmt: skip
    """Build a block above the floor of the world, which is the plane of its lowest nodes.

    Args:
        gap: free height under the block at the start [m].
        run_out: free length beside the block [m].
        angle: gravity is tilted by this angle [rad] along the first axis.
    """
    dim, dx = point.dim, SIDE / point.cells
    side = 3.0 * dx
    size = [np.ceil((run_out + SIDE) / dx) * dx + 2 * side, *[SIDE + 2 * side] * (dim - 2), SIDE + gap + 2 * side]
    world = {"size": [float(np.ceil(edge / dx - 1e-9) * dx) for edge in size], "dx": dx}
    world["gravity"] = [GRAVITY * np.sin(angle)] + [0.0] * (dim - 2) + [-GRAVITY * np.cos(angle)]
    block = Block((side,) * (dim - 1) + (gap,), (SIDE,) * dim)
    data = scene(point, block, world, boundaries={"floor": floor}, **sections)
    return with_time(data, point, seconds / frames, frames)


def _face(dim: int) -> str:
    return "xyz"[dim - 1] + "_min"


def bounce(point: Point) -> Measured:
    """Drop the block; compare the speeds of its centre before and after, and how near it comes to the floor."""
    fall = float(np.sqrt(2.0 * DROP / GRAVITY))
    dashpot = {} if point.case == DEFAULT_DASHPOT else {"dashpot": 0.0}
    floor = {"separate": {"face": _face(point.dim), **dashpot}}
    built = _block_on_floor(point, DROP, floor, 2.5 * fall, 1000)
    matter = Matter.of(built, point)
    start = DROP * GRAVITY * matter.mass.sum()

    def see(state: State, nodes: Nodes | None) -> Array:
        height = matter.centre(state.x - matter.X)[-1]
        energy = (
            matter.kinetic_energy(state, nodes) + matter.elastic_energy(state) + matter.mass.sum() * GRAVITY * height
        )
        return np.array([matter.centre(state.v)[-1], height, energy + start])

    found = observe_nodes(built, see)
    lowest = int(np.argmin(found[:, 1]))
    down, up = -found[:lowest, 0].min(), float(found[lowest:, 0].max())
    touch = int(np.argmin(found[:, 0]))
    return {
        "rebound": up / down, "energy_after": found[-1, 2] / start,
        "gap_at_contact": (DROP + found[touch, 1]) / matter.dx,
    }  # fmt: skip


def rest(point: Point) -> Measured:
    """Let the block come to rest on the floor; the gap is that of its lower face, half a spacing below particles."""
    dx = SIDE / point.cells
    loads = {"air": {"damping": {"rate": REST_DAMPING}}}
    built = _block_on_floor(point, 2.0 * dx, {"separate": {"face": _face(point.dim)}}, 1.5, 150, loads=loads)
    matter = Matter.of(built, point)
    bottom = matter.X[:, -1] < matter.X[:, -1].min() + 0.5 * matter.spacing

    def see(state: State) -> Array:
        face = (state.x - 0.5 * matter.spacing * state.F[:, :, -1])[bottom, -1]
        return np.array([face.mean(), matter.centre(state.v)[-1]])

    found = observe(built, see)
    return {"gap": found[-1, 0] / dx, "speed": abs(found[-1, 1])}


def incline(point: Point) -> Measured:
    """Put the block on the incline: its acceleration where it slides, its creep where it sticks."""
    friction = FRICTION[point.case]
    pull = GRAVITY * (np.sin(ANGLE) - friction * np.cos(ANGLE))
    seconds = 0.3 if point.case == "slides" else 1.0
    way = 0.5 * max(pull, 0.0) * seconds**2
    floor = {"friction": {"face": _face(point.dim), "coefficient": friction}}
    sections = {} if point.case == "slides" else {"loads": {"air": {"damping": {"rate": REST_DAMPING}}}}
    # one cell above the floor, where the updated frame's body touches it already
    start = SIDE / point.cells if point.frame == "updated" else 0.0
    built = _block_on_floor(point, start, floor, seconds, 200, way + SIDE, ANGLE, **sections)
    matter = Matter.of(built, point)
    found = observe(built, lambda state: np.append(matter.centre(state.v), matter.centre(state.x - matter.X)))
    time = built.scene.time.control_step * np.arange(len(found))
    later = time > 0.3 * seconds
    # friction takes mu times the momentum that the floor gives: v + mu w grows evenly, whether the block bounces or not
    balance = found[:, 0] + friction * found[:, point.dim - 1]
    slope = float(np.polyfit(time[later], balance[later], 1)[0])
    end = time > 0.75 * seconds  # where the block no longer trembles from its start
    creep = abs(float(np.polyfit(time[end], found[end, point.dim], 1)[0]))
    sliding = point.case == "slides"
    return {"acceleration": slope / pull if sliding else np.nan, "creep": np.nan if sliding else creep}


LAW = ("fixed_corotated", 0.3)

BOUNCE = Test(
    name="bounce",
    summary=f"block of 3 cm dropped from {100 * DROP:g} cm",
    columns={
        "rebound": "speed after the bounce over speed before",
        "energy_after": "energy after the bounce over energy before",
        "gap_at_contact": "height of the lower face at first contact [cells]",
    },
    ideal={"energy_after": 1.0, "gap_at_contact": 0.0},
    variants=(*((*LAW, "", factor) for factor in (1, 4, 16)), (*LAW, DEFAULT_DASHPOT, 1)),
    measure=bounce,
    reference_only=(DEFAULT_DASHPOT,),
)

REST = Test(
    name="rest",
    summary="block of 3 cm at rest on a floor",
    columns={"gap": "height of the lower face above the floor [cells]", "speed": "speed at the end [m/s]"},
    ideal={"gap": 0.0, "speed": 0.0},
    variants=((*LAW, "", 1),),
    measure=rest,
)

INCLINE = Test(
    name="incline",
    summary=f"block of 3 cm on an incline of {ANGLE:g} rad; friction 0.2 (slides) and 0.5 (sticks)",
    columns={
        "acceleration": "over g (sin a - mu cos a), where it slides",
        "creep": "speed along the incline where it sticks [m/s]",
    },
    ideal={"acceleration": 1.0, "creep": 0.0},
    variants=((*LAW, "slides", 1), (*LAW, "sticks", 1)),
    measure=incline,
    decades=("creep",),
)
