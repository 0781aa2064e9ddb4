"""A free bar that turns: stretch of its positions and of its F, angular momentum and energy over six turns.

A turning bar is in equilibrium with the centrifugal force. Its F feels the stress, so the elasticity keeps F right. Its
positions follow F only as exactly as the frame advances both.
"""

from __future__ import annotations

import numpy as np

from benchmarks.convergence.points import Measured, Point, Test, references
from benchmarks.convergence.worlds import DENSITY, YOUNGS_MODULUS, Block, Matter, Nodes, observe_nodes, scene, with_time
from cqrun.build.model import Built
from cqrun.plugin.contract import Array
from cqrun.state import State

LENGTH, HEIGHT = 0.12, 0.03
SPIN = 60.0
"""Angular velocity at the start [rad/s]: a turn takes 0.1 s, and the bar becomes 1.6 % longer."""

TURNS, FRAMES_A_TURN = 6, 40


def stretch_of_a_thin_bar(poissons_ratio: float, dim: int) -> float:
    """Return the stretch of a thin bar that turns steadily, to first order: 1 + rho w^2 L^2 / (10 E).

    It is that of the line that fits the positions best, with u = rho w^2 / (2 E) (L^2 x / 4 - x^3 / 3). In plane strain
    E / (1 - nu^2) takes the place of E.
    """
    modulus = YOUNGS_MODULUS / (1.0 - poissons_ratio**2 if dim == 2 else 1.0)
    return 1.0 + DENSITY * SPIN**2 * LENGTH**2 / (10.0 * modulus)


def build_turning(point: Point, turns: int = TURNS) -> Built:
    """Build the scene; without turns it lasts one frame."""
    dim, dx = point.dim, HEIGHT / point.cells
    size = (LENGTH, *[HEIGHT] * (dim - 1))
    middle = np.ceil(0.9 * LENGTH / dx) * dx
    world = {"size": [2.0 * middle] * dim, "dx": dx}
    spin = [SPIN] if dim == 2 else [0.0, -SPIN, 0.0]
    block = Block(tuple(middle - 0.5 * edge for edge in size), size)
    period = 2.0 * np.pi / SPIN
    data = scene(point, block, world, body={"spin": spin})
    return with_time(data, point, period / FRAMES_A_TURN, max(1, turns * FRAMES_A_TURN))


def measure(point: Point) -> Measured:
    """Let the bar turn; the stretches are means over the last half turn, because the bar also vibrates."""
    built, dim = build_turning(point), point.dim
    matter = Matter.of(built, point)
    arm = matter.X[:, 0] - matter.centre(matter.X)[0]

    def see(state: State, nodes: Nodes | None) -> Array:
        along = arm @ (state.x - matter.centre(state.x)) / (arm @ arm)  # image of the bar's axis
        of_F = matter.centre(np.linalg.norm(state.F[:, :, 0], axis=1))
        energy = matter.kinetic_energy(state, nodes) + matter.elastic_energy(state)
        return np.array([np.linalg.norm(along), of_F, matter.angular_momentum(state, nodes), energy])

    found = observe_nodes(built, see)
    half = FRAMES_A_TURN // 2
    steady = references()["references"][f"{dim}D {point.law} nu {point.poissons_ratio:g} turning_bar"]
    first = found[half : FRAMES_A_TURN + 1].mean(0)
    last = found[-half - 1 :].mean(0)
    return {
        "stretch_1": first[0] / steady["stretch"], "stretch_6": last[0] / steady["stretch"],
        "stretch_of_F_6": last[1] / steady["stretch_of_F"],
        "angular_momentum_6": last[2] / found[0, 2], "energy_6": last[3] / found[0, 3],
    }  # fmt: skip


TEST = Test(
    name="turning_bar",
    summary=f"free bar 12 x 3 cm, {SPIN:g} rad/s, {TURNS} turns",
    columns={
        "stretch_1": "positions: stretch over reference, 1 turn",
        "stretch_6": "positions: stretch over reference, 6 turns",
        "stretch_of_F_6": "F: stretch over reference, 6 turns",
        "angular_momentum_6": "after 6 turns over that at the start",
        "energy_6": "after 6 turns over that at the start",
    },
    ideal={"stretch_1": 1.0, "stretch_6": 1.0, "stretch_of_F_6": 1.0, "angular_momentum_6": 1.0, "energy_6": 1.0},
    variants=tuple(("fixed_corotated", 0.3, "", factor) for factor in (1, 16)),
    measure=measure,
    hidden=("angular_momentum_6",),
)
