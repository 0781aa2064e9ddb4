"""The arguments of the reference frame's kernels: nodes, particles in tiles, points, and cotangents."""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.engine.stencils import Stencils
from cqrun.forces.pulled import Pulled
from cqrun.numerics.compile import own_symbols
from cqrun.plugin.contract import Array

TILE = 128
"""Number of particles in a tile: its moments, stresses and fields fit the first-level cache."""


class NodeSetting(NamedTuple):
    """Constants of a rollout."""

    dims: tuple[int, ...]  # as long as the dimension
    strides: tuple[int, int, int]  # of nodes along the loop axes; the first is 0 in 2D
    dx: float
    dt: float
    substeps: int  # in a control step
    rates: tuple[int, ...]  # one entry if a stress depends on the velocity gradient, else none


class Nodes(NamedTuple):
    """Numbers of the nodes that do not change in a rollout, (M,) each."""

    mass: Array  # [kg]
    kept: Array  # sum w m kappa: what damping leaves of a node's momentum after a substep, divided by its velocity
    bits: Array  # bit k: boundary condition k applies to the node
    active: Array  # (A,) nodes with mass, increasing


class Tiles(NamedTuple):
    """One tile of particles for each thread: what is gathered, and what is scattered."""

    value: Array  # (threads, TILE, 4) and the rest (threads, 3 TILE, 4)
    moment: Array
    value_2: Array
    moment_2: Array
    moment_3: Array


class Points(NamedTuple):
    """Points of the bodies between the nodes: their weights, and for each node the points that it moves."""

    columns: Array  # (P,) of the particle that moves the point
    node: Array  # (P, 3^D) nodes of a point's stencil
    weight: Array  # (P, 3^D)
    nodes: Array  # (K,) nodes that points reach, increasing
    begin: Array  # (K + 1,) where the points of a node begin
    point: Array  # the points of each node
    share: Array  # their weights


own_symbols(Points)


class PointLoads(NamedTuple):
    """Points that forces pull, and tables of them, packed as the particles' state is."""

    points: Points
    pulled: Pulled  # its columns are the numbers of the points
    particle: Array  # (P,) that moves the point, in user order; -1 for one that is fixed in the world
    rest: Array  # (P, D) [m]
    q: Array  # (2 D, n) positions and velocities
    push: Array  # (D, n) changes or cotangents of the forces


own_symbols(PointLoads)


class NodeRun(NamedTuple):
    """What stays the same in a rollout, and the arrays in which a substep works."""

    setting: NodeSetting
    nodes: Nodes
    stencils: Stencils
    units: Array  # (U, 2) columns of each unit
    rest: Array  # (D, n) positions at rest, packed [m]
    fields: Array  # of particles, packed
    push: Array  # (D, n) steady forces, packed [N]; without columns if there are none
    force: Array  # (M, 4) internal forces [N]
    outside: Array  # (M, 4) external forces, which are constant in a control step [N]
    q: Array  # (rows, n) the particles' state at the end of a control step, packed; histories as in `history.py`
    tiles: Tiles
    least: Array  # (6, 13) the particles that were deformed most so far (`stretch.py`)
    stray: Array  # (1,) first node that is not finite, else -1
    arrivals: Array  # of the barrier (`team.py`)


class ShapeBars(NamedTuple):
    """Cotangents of the rest positions (`shape.py`), and a tile of forces for each thread."""

    place: Array  # (n, 4) of the particles' places in their stencils [cells], as a record
    rest: Array  # (D, n) of the positions from which displacements count, packed
    point_rest: Array  # (P, D) of points that forces pull, and of their weights
    point_weight: Array  # (P, 3^D)
    value: Array  # (threads, TILE, 4)
    affine: Array  # (threads, 3 TILE, 4)


own_symbols(ShapeBars)


class NodeBars(NamedTuple):
    """Cotangents, and the arrays in which the adjoint of a substep works."""

    u: Array  # (M, 4) of the displacement and of the velocity
    v: Array
    pairs: Array  # (2 M, 4) at each node the displacement and the cotangent of its force
    sums: Array  # (2 M, 4) what the sweep adds: to the cotangent of u, and the force, or to the cotangent of v
    mass: Array  # (M,) of `Nodes.mass` and `Nodes.kept`
    kept: Array
    ghost: Array  # (R,) of `Ghost.scale`
    outside: Array  # (M, 4) of the external forces, summed over a control step
    fields: Array  # of the particles, packed
    q: Array  # (rows, n) of the particles' state, packed; while substeps run, those of the histories
    steady: Array  # (D, n) of the steady forces, packed
    friction: Array  # (conditions,) of the boundaries' coefficients
    shape: tuple[ShapeBars, ...]  # one entry if rest positions have a cotangent, else none


class NodeStep(NamedTuple):
    """One substep: its control step, and the state of the nodes before and after it."""

    control: int
    u: Array  # (M, 4) [m]
    v: Array  # (M, 4) [m/s]
    v_next: Array


Groups = Any
"""A tuple of `setting.Group`."""
