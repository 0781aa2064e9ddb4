"""The arguments of the kernels of both frames: threads, bodies, what drives them, and what is recorded."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.blocks import BLOCK
from cqrun.forces.force import Levels
from cqrun.forces.pulled import Pulled, PulledLanes
from cqrun.plugin.contract import Array

MARGIN = 3
"""Number of grid nodes beyond each face of the world; they keep the stencils near a wall on the grid."""


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
