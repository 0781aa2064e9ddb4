"""What the kernels share: constants, work arrays, and the parameters of each body."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.blocks import BLOCK, Blocks, make_blocks
from cqrun.engine.team import Team
from cqrun.forces.force import Levels, Shares
from cqrun.numerics.packed import aligned
from cqrun.plugin.contract import Array

MARGIN = 3
"""Grid nodes beyond each face of the world, so that stencils near a wall stay on the grid."""

TILE = 512
"""Particles gathered at a time into arrays that stay in the first cache."""


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
    """A body's columns, the terms of its stress, and the lanes of it that forces pull.

    A pulled lane is written once more after the forces are known, so tiles need not wait for them (`forces.py`).
    """

    lo: int
    hi: int
    terms: tuple[Any, ...]
    lanes: Array  # (L,) first columns of the lanes with pulled particles, increasing
    pulled: Array  # (L + 1,) where the particles of each of these lanes begin in `Pulled.columns`


class Stresses(NamedTuple):
    """Active stresses of one kind; as a cotangent, theta and weight are theirs.

    theta is the sum over a particle's actuators of activation strength weight direction.
    """

    theta: Array  # (rows, n) parameters of the kind's stress term, packed [Pa]
    start: Array  # (A_k + 1,) where an actuator's columns begin
    columns: Array  # particles of all actuators of the kind
    actuators: Array  # (A_k,) which of all A actuators they are
    direction: Array  # (A_k, rows)
    weight: Array  # of each of the columns [1]


class Pulled(NamedTuple):
    """The particles that forces pull, and which shares each of them adds up."""

    columns: Array  # (P,) increasing
    begin: Array  # (P + 1,) where the shares of a particle begin in `order`
    order: Array  # (S,) shares, those of a particle in the order in which they are added
    shares: Shares  # of all kinds of force
    base: Array  # (P, D) the steady force on each [N]


class Drive(NamedTuple):
    """What drives particles: the parts of actuators, and after them those of forces without an activation.

    As a cotangent, the theta and weight of the stresses and the levels are theirs.
    """

    levels: Levels
    stresses: tuple[Stresses, ...]  # one a kind of active stress
    steady: tuple[Any, ...]  # one kernel a kind of steady force
    forces: tuple[Any, ...]  # one kernel a kind of force that depends on the state
    pulled: Pulled


class Probe(NamedTuple):
    """Weighted sums of particles to record, a sparse matrix (K, n); rows of many particles apart, in PADDING parts."""

    start: Array  # (K + 1,) compressed rows of few particles: columns, weights; those of many are empty here
    columns: Array
    weights: Array
    rows: Array  # (R,) which rows have many, and in which runs of PADDING columns (begin (R + 1,), runs)
    begin: Array
    runs: Array
    shares: Array  # (runs * PADDING / 4, 4) weights of the columns of a run
    sums: Array  # (rows of q * PADDING / 4, 4) of one row, PADDING parts of its sum


class Work(NamedTuple):
    """Arrays that passes hand to each other."""

    value: Array  # (n, 4), affine (3 n, 4), place (n, 4): what P2G scatters
    affine: Array
    place: Array
    value_2: Array  # what the adjoint of G2P scatters; empty (0, 4) in a forward rollout
    affine_2: Array
    grid: Array  # (nodes, 4) momentum and mass, then velocity after the boundaries
    both: Array  # (2 nodes, 4) in the adjoint: every node's record as in `grid`, and after it that of its cotangent
    held: Array  # (nodes,) bit k: boundary condition k holds the node
    friction_bar: Array  # (blocks * conditions,) partial sums
    speed: Array  # (threads,) greatest |v|^2 of the substep [m^2/s^2]
    stray: Array  # (threads,) first particle that left the grid or is not finite, else -1
    tile_value: Array  # (threads, TILE, 4), tile_moment (threads, 3 TILE, 4): what a thread gathers at a time
    tile_moment: Array
    tile_slope: Array  # (threads, TILE, 4)
    blocks: Blocks
    arrivals: Array  # where threads meet (`team.py`)


# --- what passes take: what stays the same through a rollout, the cotangents, one substep, one thread -------------


class Run(NamedTuple):
    """What all passes of a rollout work with."""

    setting: Setting
    work: Work
    fields: Array  # of particles (`state.py`), packed
    push: Array  # (D, n) force of actuators and forces on particles, packed [N]; no columns where nothing pushes


class Bars(NamedTuple):
    """The cotangents of the state and of what all particles have, packed."""

    q: Array  # from that of q_next to that of q
    fields: Array
    push: Array  # of one substep
    steady_push: Array  # of the steady forces, summed over a control step; no columns where there are none


class Substep(NamedTuple):
    """One substep, from the state q to q_next, which may be q.

    `begun` says that the substep before has done this one's first pass, `ahead` that this one does the first of the
    next (`step.py`); backward, before and next change places. Particles are sorted where `due` is a multiple of
    SORT_EVERY.
    """

    control: int
    due: int
    begun: bool
    ahead: bool
    q: Array
    q_next: Array
    q_before: Array  # the state that the substep before began from; used backward if `ahead`


class Crew(NamedTuple):
    """One of the threads that run a pass together."""

    thread: int
    n_threads: int


def make_pulled(shares: Shares) -> Pulled:
    """Return which particles all shares pull, in the order of their columns."""
    columns, order = np.unique(shares.columns), np.argsort(shares.columns, kind="stable")
    begin = np.append(np.searchsorted(shares.columns[order], columns), len(order))
    base = np.zeros((len(columns), shares.force.shape[1]))
    return Pulled(columns.astype(np.int64), begin.astype(np.int64), order.astype(np.int64), shares, base)


def pulled_lanes(columns: Array, lo: int, hi: int, width: int) -> tuple[Array, Array]:
    """Return the lanes of columns lo .. hi that hold pulled particles: their first columns, and `Group.pulled`."""
    first, last = np.searchsorted(columns, [lo, hi])
    lanes = np.unique(columns[first:last] // width) * width
    return lanes.astype(np.int64), np.searchsorted(columns, [*lanes, hi]).astype(np.int64)


def grid_shape(size: Array, dx: float) -> tuple[int, ...]:
    """Return the number of nodes along each axis, a whole number of blocks."""
    cells = np.ceil(np.asarray(size) / dx - 1e-9)  # floats, which hold any number of them
    return tuple(BLOCK * int(blocks) for blocks in np.ceil((cells + 1 + 2 * MARGIN) / BLOCK))


def node_positions(shape: tuple[int, ...], dx: float) -> Array:
    """Return every node's position (nodes, D) [m] in row-major order."""
    axes = [(np.arange(n) - MARGIN) * dx for n in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(shape))


def make_work(
    shape: tuple[int, ...], n: int, held: Array, n_conditions: int, real: Any, *, adjoint: bool, team: Team
) -> Work:
    """Return work arrays for a grid of `shape` nodes and n particle columns."""
    loop_shape = (1, *shape) if len(shape) == 2 else shape
    n_nodes = int(np.prod(shape))
    blocks = (-(-loop_shape[0] // BLOCK), loop_shape[1] // BLOCK, loop_shape[2] // BLOCK)
    n_2, nodes_2 = (n, n_nodes) if adjoint else (0, 0)
    threads = team.size

    def records(*rows: int) -> Array:
        return aligned((*rows, 4), real)

    return Work(
        records(n), records(3 * n), records(n), records(n_2), records(3 * n_2),
        records(n_nodes), records(2 * nodes_2), held,
        np.zeros(int(np.prod(blocks)) * n_conditions), np.zeros(threads), np.full(threads, -1),
        records(threads, TILE), records(threads, 3 * TILE), records(threads, TILE),
        make_blocks(blocks, n), team.arrivals,
    )  # fmt: skip


def node_strides(shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return the node strides along the three loop axes."""
    return (shape[1] * shape[2], shape[2], 1) if len(shape) == 3 else (0, shape[1], 1)
