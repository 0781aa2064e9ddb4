"""The arguments of the updated frame's kernels: constants, work arrays, and the cotangents."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.blocks import BLOCK, Blocks, make_blocks
from cqrun.engine.team import Team
from cqrun.numerics.packed import aligned
from cqrun.plugin.contract import Array

TILE = 512
"""Number of particles that are gathered at a time; their arrays fit the first-level cache."""


class Setting(NamedTuple):
    """Constants of a rollout."""

    dims: tuple[int, ...]  # as long as the dimension
    strides: tuple[int, int, int]  # of nodes along the loop axes; the first is 0 in 2D
    upper: tuple[float, ...]  # (D,) a position must stay below this, in cells
    dx: float
    dt: float
    substeps: int  # in a control step
    chained: bool  # whether substeps follow each other tile by tile (`step.follows`)


class Work(NamedTuple):
    """Arrays that one pass writes and another reads."""

    value: Array  # (n, 4), affine (3 n, 4), place (n, 4): the fields that P2G scatters
    affine: Array
    place: Array
    value_2: Array  # the fields that the adjoint of G2P scatters; empty (0, 4) in a forward rollout
    affine_2: Array
    grid: Array  # (nodes, 4) momentum and mass, then velocity after the boundaries
    both: Array  # (2 nodes, 4) in the adjoint: the record of each node as in `grid`, then that of its cotangent
    condition_bits: Array  # (nodes,) bit k: boundary condition k applies to the node
    friction_bar: Array  # (blocks * conditions,) partial sums
    speed: Array  # (threads,) largest |v|^2 of the substep [m^2/s^2]
    stray: Array  # (threads,) first particle that left the grid or is not finite, else -1
    tile_value: Array  # (threads, TILE, 4), tile_moment (threads, 3 TILE, 4): one tile of each thread
    tile_moment: Array
    tile_slope: Array  # (threads, TILE, 4)
    blocks: Blocks
    arrivals: Array  # of the barrier (`team.py`)


class Run(NamedTuple):
    """The arguments that stay the same in a rollout."""

    setting: Setting
    work: Work
    fields: Array  # of particles (`state.py`), packed
    push: Array  # (D, n) force of actuators and forces on particles, packed [N]; without columns if there are none


class Bars(NamedTuple):
    """The cotangents of the state and of the fields of all particles, packed."""

    q: Array  # of q_next before a substep's adjoint, of q after it
    fields: Array
    push: Array  # of one substep
    steady_push: Array  # of the steady forces, summed over a control step; without columns if there are none


class Substep(NamedTuple):
    """One substep, from the state q to q_next, which may be q.

    If `begun`, the previous substep has already run the first pass of this one; if `ahead`, this one runs the first
    pass of the next (`step.py`). Particles are sorted if `due` is a multiple of SORT_EVERY.
    """

    control: int
    due: int
    begun: bool
    ahead: bool
    q: Array
    q_next: Array
    q_before: Array  # the state before the previous substep; the adjoint uses it if `ahead`
    q_after: Array  # the state after the next substep; the forward run uses it if `ahead`


def make_work(
    shape: tuple[int, ...], n: int, bits: Array, n_conditions: int, real: Any, *, adjoint: bool, team: Team
) -> Work:
    """Return work arrays for a grid of `shape` nodes and n particle columns."""
    blocks = (*(1,) * (3 - len(shape)), *(nodes // BLOCK for nodes in shape))
    n_nodes, threads = int(np.prod(shape)), team.size
    n_2, nodes_2 = (n, n_nodes) if adjoint else (0, 0)

    def records(*rows: int) -> Array:
        return aligned((*rows, 4), real)

    return Work(
        records(n), records(3 * n), records(n), records(n_2), records(3 * n_2), records(n_nodes), records(2 * nodes_2),
        bits, np.zeros(int(np.prod(blocks)) * n_conditions), np.zeros(threads), np.full(threads, -1),
        records(threads, TILE), records(threads, 3 * TILE), records(threads, TILE), make_blocks(blocks, n),
        team.arrivals,
    )  # fmt: skip


def node_strides(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return the node strides along the three loop axes."""
    return (shape[1] * shape[2], shape[2], 1) if len(shape) == 3 else (0, shape[1], 1)
