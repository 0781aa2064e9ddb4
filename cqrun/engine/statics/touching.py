"""Contact at equilibrium: points of surfaces against obstacles and rigid bodies, without friction, and its adjoint.

The law is that of a motion (reference/rub.py) at rest: a point at depth h > 0 feels f = K h n, so it has a potential,
and a symmetric tangent, with the curvature alpha of the surface and its direction t without curvature:

    df/dx = T = K h alpha (I - n n^T - t t^T) - K n n^T

A rigid body on a path is where its last waypoint says, as a boundary that moves is at its place at once. With the
cotangent p of a point's force, y_bar = T p is that of its place, and a rigid body gets c_bar = -y_bar and theta_bar =
n x (K h p) - (x - c) x y_bar (`reference/grip.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from cqrun.engine.model import Inputs, Model
from cqrun.engine.reference.contact import Obstacles, make_obstacles, make_surface
from cqrun.engine.reference.grip import surface_at
from cqrun.engine.reference.points import riding_points_vjp
from cqrun.engine.reference.poses import POSE_BAR, own_waypoints, table_of, table_of_vjp
from cqrun.engine.reference.rest import RestGeometry
from cqrun.engine.reference.rigid import seen_poses
from cqrun.engine.rigid_model import OFFSET, RigidModel
from cqrun.numerics.compile import kernel, own_symbols
from cqrun.plugin.contract import Array

HeldBar = Mapping[str, tuple[Array, Array]]
"""Cotangents of the force (D,) and the moment (1,) or (3,) of boundaries and rigid bodies, by name."""


class Placed(NamedTuple):
    """Rigid bodies that do not move: what the kernels of grip.py need of `Rigid`."""

    first: int
    center: Array
    pose: Array


own_symbols(Placed)


@kernel
def look_at_surfaces(rigid: tuple[Placed, ...], obstacles: Obstacles, x: Array, out: Array) -> None:
    """Write (d, n, alpha, t) of every obstacle at points x (S, 3) to out (S, O, 8)."""
    for s in range(x.shape[0]):
        for o in range(out.shape[1]):
            d, n, alpha, t = surface_at(rigid, obstacles, o, (x[s, 0], x[s, 1], x[s, 2]))
            out[s, o, 0], out[s, o, 4] = d, alpha
            for k in range(3):
                out[s, o, 1 + k], out[s, o, 5 + k] = n[k], t[k]


class Felt(NamedTuple):
    """What points feel: for each pair of a point and an obstacle that touch (n,)."""

    point: Array
    obstacle: Array
    x: Array  # (n, 3) the point [m]
    normal: Array  # (n, 3)
    force: Array  # (n,) K h [N]
    tangent: Array  # (n, 3, 3) df/dx [N/m]


class StillContact:
    """Contact of one model at rest.

    Attributes:
        names: of the obstacles: of their boundaries, then of the rigid bodies.
    """

    def __init__(self, model: Model, inputs: Inputs, rest: RestGeometry) -> None:
        self.model, self.inputs, self.rest = model, inputs, rest
        self.surface = make_surface(model, rest, inputs.surface)
        points = self.surface.points
        row = np.repeat(np.arange(len(points.node)), points.node.shape[1])
        shape = len(points.node), rest.patches.n_nodes
        self.weights = sparse.csr_array((points.weight.ravel(), (row, points.node.ravel())), shape)
        self.obstacles = make_obstacles(model, inputs, rigid=True)
        self.names = [model.conditions[each.condition].name for each in model.obstacles]
        self.names += [body.name for body in model.rigid]
        poses = [self._table(b, body)[-1] for b, body in enumerate(model.rigid)]
        center = np.array([body.center for body in model.rigid])
        self.placed = (Placed(len(model.obstacles), center, np.array(poses)),) if poses else ()
        self.felt = self.feel(np.zeros((shape[1], 4)))

    def feel(self, u: Array) -> Felt:
        """Return what points feel at a displacement of the nodes (M, 4) [m]."""
        x = np.ascontiguousarray(self.surface.rest + self.weights @ u[:, :3])
        out = np.zeros((len(x), len(self.names), 8))
        look_at_surfaces(self.placed, self.obstacles, x, out)
        s, o = np.nonzero(out[..., 0] < 0.0)
        d, n, alpha, t = out[s, o, 0], out[s, o, 1:4], out[s, o, 4], out[s, o, 5:8]
        K, nn = self.surface.stiffness[s], np.einsum("ni,nj->nij", n, n)
        flat = np.eye(3) - nn - np.einsum("ni,nj->nij", t, t)
        tangent = K[:, None, None] * ((-d * alpha)[:, None, None] * flat - nn)
        return Felt(s, o, x[s], n, -K * d, tangent)

    def forces(self, u: Array) -> Array:
        """Return the forces on the nodes (M, 3) [N] at a displacement."""
        return self._to_nodes(*_forces(self.feel(u)))

    def linearise(self, u: Array) -> None:
        """Keep the tangent at a displacement, for `change` and `add_blocks`."""
        self.felt = self.feel(u)

    def change(self, p: Array) -> Array:
        """Return the change of the forces on the nodes (M, 3) with a displacement p (M, 4)."""
        moved = self.weights @ p[:, :3]
        return self._to_nodes(self.felt.point, np.einsum("nij,nj->ni", self.felt.tangent, moved[self.felt.point]))

    def add_blocks(self, blocks: Array) -> None:
        """Add to the diagonal blocks of the stiffness (M, D, D)."""
        dim, points = blocks.shape[1], self.surface.points
        node, weight = points.node[self.felt.point], points.weight[self.felt.point]
        own = weight[:, :, None, None] ** 2 * self.felt.tangent[:, None, :dim, :dim]
        np.subtract.at(blocks, node, own)

    def held_by(self, u: Array) -> dict[str, tuple[Array, Array]]:
        """Return force (D,) [N] and moment (1,) or (3,) [N m] of every obstacle on the bodies, by name.

        The moment is about the centre of a rigid body, or the world's origin.
        """
        felt, dim, found = self.feel(u), self.model.dim, {}
        force, arms = felt.force[:, None] * felt.normal, self._arms(felt)
        for name in dict.fromkeys(self.names):
            own = np.isin(felt.obstacle, [k for k, other in enumerate(self.names) if other == name])
            moment = np.cross(arms[own], force[own]).sum(axis=0)
            found[name] = force[own].sum(axis=0)[:dim], moment[2:] if dim == 2 else moment
        return found

    # --- the adjoint --------------------------------------------------------------------------------------------------

    def u_bar(self, u: Array, held_bar: HeldBar) -> Array:
        """Return the cotangent of the displacements (M, 3) from those of `held_by`."""
        felt = self.feel(u)
        return self._to_nodes(felt.point, self._place_bars(felt, *self._own_bars(felt, held_bar)))

    def add_bars(self, u: Array, adjoint: Array, held_bar: HeldBar, bar: Inputs) -> None:
        """Add to the cotangent of the inputs, from those of the forces on nodes (M, 4) and of `held_by`."""
        felt = self.feel(u)
        force_bar, moment_bar = self._own_bars(felt, held_bar)
        force_bar = force_bar + (self.weights @ adjoint[:, :3])[felt.point]
        place_bar, arms = self._place_bars(felt, force_bar, moment_bar), self._arms(felt)
        y_bar = np.einsum("nij,nj->ni", felt.tangent, force_bar)
        turn_bar = np.cross(felt.normal, felt.force[:, None] * force_bar) - np.cross(arms, y_bar)
        places = own_waypoints(self.model.rigid)
        for b, body in enumerate(self.model.rigid):
            own = felt.obstacle == len(self.model.obstacles) + b
            pose_bar = np.zeros((1 if not len(body.times) else 2, POSE_BAR))
            pose_bar[-1, :3], pose_bar[-1, 3:6] = -place_bar[own].sum(axis=0), turn_bar[own].sum(axis=0)
            given = self.inputs.waypoints[places[b]]
            offset_bar, waypoints_bar = table_of_vjp(body, given, _moments(body), pose_bar)
            bar.rigid[b, OFFSET] += offset_bar
            bar.waypoints[places[b]] += waypoints_bar
        if self.inputs.shaped:
            self._add_shape_bars(felt, u, adjoint, place_bar, bar)

    def _add_shape_bars(self, felt: Felt, u: Array, adjoint: Array, place_bar: Array, bar: Inputs) -> None:
        """Add the cotangents of points at rest and of their weights: x = X + sum w u, f_n = w f."""
        model, surface, dim, points = self.model, self.model.surface, self.model.dim, self.surface.points
        assert surface is not None
        force, node = felt.force[:, None] * felt.normal, points.node[felt.point]
        weight_bar, x_bar = np.zeros(points.weight.shape), np.zeros((len(points.node), 3))
        np.add.at(x_bar, felt.point, place_bar)
        for own, of_nodes in ((place_bar, u), (force, adjoint)):
            np.add.at(weight_bar, felt.point, np.einsum("ni,nki->nk", own, of_nodes[node][..., :3]))
        x = self.surface.rest[:, :dim]
        found = riding_points_vjp(self.rest.patches, self.rest.x, surface.particle, x, model.dx, weight_bar)
        bar.state.x += found[1]
        if len(bar.surface):
            bar.surface += found[0] + x_bar[:, :dim]

    def _place_bars(self, felt: Felt, force_bar: Array, moment_bar: Array) -> Array:
        """Return the cotangents of the points (n, 3), from those of their forces and of moments with their arms."""
        force = felt.force[:, None] * felt.normal
        return np.asarray(np.einsum("nij,nj->ni", felt.tangent, force_bar) + np.cross(force, moment_bar))

    def _own_bars(self, felt: Felt, held_bar: HeldBar) -> tuple[Array, Array]:
        """Return the cotangents of forces (n, 3), and of the moments that they belong to (n, 3), from reactions."""
        dim, count = self.model.dim, len(self.names)
        F, M = np.zeros((count, 3)), np.zeros((count, 3))
        for k, name in enumerate(self.names):
            if name in held_bar:
                F[k, :dim], M[k, 2 if dim == 2 else 0 :] = held_bar[name]
        moment_bar = M[felt.obstacle]
        return F[felt.obstacle] + np.cross(moment_bar, self._arms(felt)), moment_bar

    # --- inside -------------------------------------------------------------------------------------------------------

    def _arms(self, felt: Felt) -> Array:
        """Return the arms of moments (n, 3): from the centre of a rigid body, or the world's origin."""
        origins = [np.zeros((len(self.model.obstacles), 3)), *(placed.pose[:, :3] for placed in self.placed)]
        return np.asarray(felt.x - np.concatenate(origins)[felt.obstacle])

    def _to_nodes(self, point: Array, values: Array) -> Array:
        """Return the sum of the points' vectors (n, 3) on the nodes (M, 3)."""
        each = np.zeros((self.weights.shape[0], 3))
        np.add.at(each, point, values)
        return np.asarray(self.weights.T @ each)

    def _table(self, b: int, body: RigidModel) -> Array:
        given = self.inputs.waypoints[own_waypoints(self.model.rigid)[b]]
        return table_of(replace(body, free=False), self.inputs.rigid[b], given, _moments(body))


def poses_at_rest(model: Model, inputs: Inputs) -> dict[str, Array]:
    """Return displacement, rotation, velocity and angular velocity (6 or 12,) of every rigid body at rest, by name."""
    found, places = {}, own_waypoints(model.rigid)
    for body, number, at in zip(model.rigid, inputs.rigid, places, strict=True):
        pose = table_of(body, number, inputs.waypoints[at], _moments(body))[-1]
        pose[7:] = 0.0
        found[body.name] = seen_poses(pose, body.center, model.dim)
    return found


def _forces(felt: Felt) -> tuple[Array, Array]:
    return felt.point, felt.force[:, None] * felt.normal


def _moments(body: RigidModel) -> Array:
    """Return the two times between which the path of a body leads to its last waypoint (2,) [s]."""
    end = float(body.times[-1]) if len(body.times) else 1.0
    return np.array([0.0, end if end > 0.0 else 1.0])


def make_contact_at_rest(model: Model, inputs: Inputs, rest: RestGeometry) -> StillContact | None:
    """Return the contact of a model at rest; None if its bodies touch nothing."""
    touched: Any = model.obstacles or model.rigid
    return StillContact(model, inputs, rest) if touched and model.surface is not None else None


def contact_names(contact: StillContact | None) -> Iterator[str]:
    """Yield the names of all that bodies touch."""
    yield from dict.fromkeys([] if contact is None else contact.names)
