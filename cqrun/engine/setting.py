"""The arguments of the kernels: constants, work arrays, and the parameters of each body."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.blocks import BLOCK, Blocks, make_blocks
from cqrun.engine.team import Team
from cqrun.forces.force import Levels
from cqrun.forces.pulled import Pulled, PulledLanes
from cqrun.numerics.packed import aligned
from cqrun.plugin.contract import Array

MARGIN = 3
"""Number of grid nodes beyond each face of the world; they keep the stencils near a wall on the grid."""

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


class Group(NamedTuple):
    """Consecutive bodies with the same terms of stress: columns lo .. hi, and the lanes in them that forces pull."""

    lo: int
    hi: int
    terms: tuple[Any, ...]
    pulled: tuple[PulledLanes, ...]  # one entry, or none if no force depends on the state


class Stresses(NamedTuple):
    """Active stresses of one kind (`drive.py`); a cotangent differs from it in theta and weight."""

    theta: Array  # (rows, n) parameters of the kind's stress term, packed [Pa]
    start: Array  # (A_k + 1,) where an actuator's columns begin
    columns: Array  # particles of all actuators of the kind
    actuators: Array  # (A_k,) their numbers among all A actuators
    direction: Array  # (A_k, rows)
    weight: Array  # of each entry of `columns` [1]


class Drive(NamedTuple):
    """The parts of actuators, then of forces without an activation; a cotangent differs in levels and stresses."""

    levels: Levels
    stresses: tuple[Stresses, ...]  # one per kind of active stress
    steady: tuple[Any, ...]  # one kernel per kind of steady force
    forces: tuple[Any, ...]  # one kernel per kind of force that depends on the state
    pulled: tuple[Pulled, ...]  # one entry, or none if `forces` is empty: then kernels hold no code for it


class Probe(NamedTuple):
    """Weighted sums of particles to record, a sparse matrix (K, n) in two parts (`probe.py`)."""

    start: Array  # (K + 1,) compressed rows with few particles: columns, weights; rows with many are empty here
    columns: Array
    weights: Array
    rows: Array  # (R,) the rows with many particles; row j has the runs begin[j] .. begin[j + 1] of PADDING columns
    begin: Array
    runs: Array
    shares: Array  # (runs * PADDING / 4, 4) weights of the columns of a run
    sums: Array  # (rows of q * PADDING / 4, 4) PADDING partial sums of one row


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


class Crew(NamedTuple):
    """One of the threads that run a pass together."""

    thread: int
    n_threads: int


def grid_shape(size: Array, dx: float) -> tuple[int, ...]:
    """Return the number of nodes along each axis, a multiple of BLOCK."""
    cells = np.ceil(np.asarray(size) / dx - 1e-9)  # floats, which hold any number of them
    return tuple(BLOCK * int(blocks) for blocks in np.ceil((cells + 1 + 2 * MARGIN) / BLOCK))


def node_positions(shape: tuple[int, ...], dx: float) -> Array:
    """Return the positions of all nodes (nodes, D) [m] in row-major order."""
    axes = [(np.arange(n) - MARGIN) * dx for n in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(shape))


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
