"""The arguments of the kernels of contact: surface points, obstacles, and which points are near them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import svds

from cqrun.boundaries.solid import Solids, make_solids
from cqrun.engine.lattice import Lattice
from cqrun.engine.model import Inputs, Model
from cqrun.engine.reference.movers import Movers, SurfaceBars, make_movers, zero_bars
from cqrun.engine.reference.patches import make_patches
from cqrun.engine.reference.points import riding_points
from cqrun.engine.reference.rest import RestGeometry, stencil_weights
from cqrun.engine.reference.rub import ONSET
from cqrun.engine.reference.setting import Points
from cqrun.engine.rigid_model import FRICTION
from cqrun.numerics.compile import own_symbols
from cqrun.numerics.packed import aligned
from cqrun.plugin.contract import Array
from cqrun.state import Layout

REACTION = 6
"""Numbers of a reaction: 3 of the force, 3 of the moment; in 2D, some of them are zero."""

MARGIN = 0.5
"""How far nodes may move until points near obstacles are looked for again [cells]."""


CHUNK = 100_000
"""Number of particles whose stencils are in memory at a time."""


class Surface(NamedTuple):
    """Points of the surfaces. Vectors have 3 entries, also in 2D."""

    points: Points
    rest: Array  # (S, 3) [m]
    stiffness: Array  # (S,) [N/m]
    impedance: Array  # (S,) [N s/m]
    onset: float  # depth at which half of a dashpot acts [m]


class Obstacles(NamedTuple):
    """Obstacles, each a union of solids."""

    solids: Solids
    begin: Array  # (O + 1,) where the solids of an obstacle begin
    coefficient: Array  # (O,) of friction
    dashpot: Array  # (O,)
    rubs: Array  # (O,) whether it has friction
    springs: int  # 1 if one of them has, and so each point a tangential spring, else 0


class Near(NamedTuple):
    """Points near obstacles. It is found again when a node has moved too far."""

    points: Array  # (S,) the first count[0] are near, in increasing order
    count: Array  # (1,)
    movers: Movers  # of the points that are near
    flag: Array  # (S,) whether a point is near
    mark: Array  # (K, 3) displacements of the nodes when it was found
    moved: Array  # (threads,) largest square of a node's way since
    margin: float  # of the distance of points [m]
    reach: float  # way of nodes that may move a point by the margin [m]


class Pushes(NamedTuple):
    """How much obstacles do to points in a control step, for the obstacles whose reactions are recorded."""

    owner: Array  # (O,) the row of each obstacle's boundary among those that are recorded, else -1
    per: float  # 1 / substeps
    sums: Array  # (S, O, 6) force and moment about the world's origin, over the substeps so far
    mean_bar: Array  # (T, B, 6) in the adjoint, cotangents of the means


class Contact(NamedTuple):
    """All of contact with obstacles, and arrays for the numbers of a point in a substep."""

    surface: Surface
    obstacles: Obstacles
    near: Near
    slid: Array  # (threads,) whether a force depended on a velocity or a spring, since it was last cleared
    force: Array  # (S, 3) on each point; in the adjoint, too [N]
    u_bar: Array  # (S, 3) cotangents of a point's position and velocity
    v_bar: Array
    friction_bar: Array  # (S, O) of the coefficients, summed over substeps
    bars: SurfaceBars
    pushes: tuple[Pushes, ...]  # one entry, or none if no reactions of obstacles are recorded
    rigid: tuple[Any, ...]  # bodies that are obstacles (`rigid.Rigid`), one entry or none


for _class in (Surface, Obstacles, Near, Pushes, Contact):
    own_symbols(_class)


def in_3d(x: Array) -> Array:
    """Return vectors (n, D) with 3 entries."""
    return np.ascontiguousarray(np.pad(np.asarray(x, np.float64), ((0, 0), (0, 3 - x.shape[1]))))


def make_surface(model: Model, rest: RestGeometry, x: Array) -> Surface:
    """Return the kernels' view of a model's surface at rest at x (S, D) [m]; an empty x stands for the model's."""
    surface = model.surface
    assert surface is not None
    x = x if len(x) else surface.x
    constants = np.array(surface.stiffness, np.float64), np.array(surface.impedance, np.float64)
    points = riding_points(rest.patches, rest.x, surface.particle, x, model.dx)
    return Surface(points, in_3d(x), *constants, ONSET * model.dx)


def make_obstacles(model: Model, inputs: Inputs, *, rigid: bool) -> Obstacles:
    """Return the kernels' view of the obstacles of boundaries, and after them of rigid bodies, if these are wanted."""
    bodies = model.rigid if rigid else ()
    every = (*model.obstacles, *bodies)
    friction = [inputs.coefficients[obstacle.condition] for obstacle in model.obstacles]
    friction += [numbers[FRICTION] for numbers in inputs.rigid[: len(bodies)]]
    solids = [solid for obstacle in every for solid in obstacle.solids]
    begin = np.cumsum([0, *(len(obstacle.solids) for obstacle in every)]).astype(np.int64)
    dashpot = np.array([obstacle.dashpot for obstacle in every], np.float64)
    rubs = np.array([obstacle.rubs for obstacle in every], np.bool_)
    return Obstacles(make_solids(solids), begin, np.array(friction, np.float64), dashpot, rubs, int(rubs.any()))


def make_contact(
    model: Model, surface: Surface, obstacles: Obstacles, rigid: tuple[Any, ...], n_threads: int
) -> tuple[Contact, ...]:
    """Return one entry, or none if there are no obstacles and no rigid bodies."""
    if not model.obstacles and not model.rigid:
        return ()
    n, k, margin = len(surface.rest), len(surface.points.nodes), MARGIN * model.dx
    near = Near(
        np.zeros(n, np.int64), np.zeros(1, np.int64), make_movers(surface.points), np.zeros(n, np.bool_),
        np.full((k, 3), np.inf), np.zeros(n_threads), margin, margin / growth_of(surface.points),
    )  # fmt: skip
    force, u_bar, v_bar = (aligned((n, 3), np.float64) for _ in range(3))
    return (
        Contact(
            surface, obstacles, near, np.zeros(n_threads, np.int64), force, u_bar, v_bar,
            np.zeros((n, len(obstacles.dashpot))), zero_bars(surface.points, False),
            make_pushes(model, n, rigid=True), rigid,
        ),
    )  # fmt: skip


def make_pushes(model: Model, n_points: int, *, rigid: bool) -> tuple[Pushes, ...]:
    """Return one entry, or none if no reactions of obstacles, or of rigid bodies if these count, are recorded."""
    names = [model.conditions[obstacle.condition].name for obstacle in model.obstacles]
    names += [body.name for body in model.rigid if rigid]
    if not set(names) & set(model.reactions):
        return ()
    owner = np.array([model.reactions.index(name) if name in model.reactions else -1 for name in names])
    mean_bar = np.zeros((model.n_controls, len(model.reactions), REACTION))
    return (Pushes(owner, 1.0 / model.substeps, np.zeros((n_points, len(names), REACTION)), mean_bar),)


def growth_of(points: Points) -> float:
    """Return the largest sum of |w| of a point: how much farther than its nodes it may move."""
    return float(np.abs(points.weight).sum(axis=1).max(initial=1.0))


def contact_square(
    layout: Layout, X: Array, mass: Array, particle: Array, x: Array, stiffness: Array, dx: float, offset: Array,
    lattice: Lattice,
) -> float:  # fmt: skip
    """Return the largest squared frequency that nodes have on the springs of their points alone [1/s^2].

    Args:
        layout: of the particles at rest at X (N, D) [m], with their masses (N,) [kg].
        particle, x, stiffness: of the points (S,), as in `SurfaceModel`.
        offset: of each body's grid from that of the world (B, D) [m].
        lattice: of the particles.
    """
    patches = make_patches(layout, X, dx, offset, lattice)
    columns, node_mass = patches.layout.columns(), np.zeros(patches.n_nodes)
    for begin in range(0, len(X), CHUNK):
        node, weight = stencil_weights(patches, columns[begin : begin + CHUNK])
        share = weight * mass[begin : begin + CHUNK, None]
        node_mass += np.bincount(node.ravel(), share.ravel(), patches.n_nodes)
    points = riding_points(patches, X, particle, x, dx)
    place, root = np.searchsorted(points.nodes, points.node), np.sqrt(stiffness)
    value = root[:, None] * points.weight / np.sqrt(node_mass[points.node])
    row = np.repeat(np.arange(len(x)), points.node.shape[1])
    matrix = sparse.csr_array((value.ravel(), (row, place.ravel())), (len(x), len(points.nodes)))
    start = np.ones(min(matrix.shape))
    return float(svds(matrix, k=1, v0=start, tol=1e-4, return_singular_vectors=False)[0] ** 2)
