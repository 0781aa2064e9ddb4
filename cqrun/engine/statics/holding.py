"""What boundaries hold of each node: the directions that it cannot move in, and which boundary takes which of them.

A plane k of a boundary leaves a node P_k v of a velocity v, and so holds the directions S_k, the range of 1 - P_k. All
planes of the node together leave free what none of them holds.

Several boundaries at a node divide its reaction r. If their directions are independent there is one way:

    r = sum_k r_k,  r_k in S_k:    r_k = N_k (N^+ r)_k,  N = [N_1, N_2, ...] with a basis N_k of each S_k

So a frictionless plane takes a force along its normal alone, also where two planes meet at an acute angle. A clamp
holds every direction. Where it meets a frictionless plane, the plane takes its normal part and the clamp the rest, as
at a plane of symmetry. Two clamps at one node, or two planes with the same normal, cannot be told apart. Then a clamp
that carries the node takes all of it, otherwise the first one in the order of the scene.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from cqrun.boundaries.condition import at_node, project
from cqrun.engine.model import ConditionModel
from cqrun.plugin.contract import Array

SAME = 1e-9
"""Two directions whose cosine differs from 1 by less are the same."""


class Holding(NamedTuple):
    """The nodes that boundaries hold (H,), and the projection of each on its free directions (H, D, D)."""

    nodes: Array
    free: Array

    def freed(self, a: Array) -> Array:
        """Return a vector of the nodes (M, 4) without what boundaries hold."""
        out, dim = a.copy(), self.free.shape[1]
        out[self.nodes, :dim] = np.einsum("hij,hj->hi", self.free, a[self.nodes, :dim])
        return out


class Shares(NamedTuple):
    """How boundaries divide the reactions of a node.

    Attributes:
        parts: matrix (D, D) of each boundary, by its name: the part of the reaction that it takes.
        alike: pairs of boundaries that cannot be told apart there: the one that takes the reaction, and the other.
    """

    parts: dict[str, Array]
    alike: tuple[tuple[str, str], ...]


class Planes:
    """The planes of a model's boundaries at nodes.

    Args:
        conditions: all planes of a model.
        size: of the world (D,) [m].
        bits: the conditions that apply to each node (M,).
        X: its place at rest (M, D) [m].
    """

    def __init__(self, conditions: Sequence[ConditionModel], size: Array, bits: Array, X: Array) -> None:
        normals = _uneven_normals(conditions, size, X)
        self.bits, self.dim, self.conditions = bits, X.shape[1], conditions
        self.kernels = [
            replace(condition, normal=normals.get(k, condition.normal)).kernel(0.0)
            for k, condition in enumerate(conditions)
        ]
        self.uneven = sum(1 << k for k in normals)
        self.names = tuple(dict.fromkeys(condition.name for condition in conditions))

    def holding(self) -> Holding:
        """Return all held nodes and their free directions."""
        nodes = np.flatnonzero(self.bits)
        free = np.zeros((len(nodes), self.dim, self.dim))
        known: dict[tuple[int, int], Array] = {}
        for row, n in enumerate(nodes):
            if (key := self._key(n)) not in known:
                known[key] = np.eye(self.dim) - _span(sum(self._held(k, n) for k in self._planes(n)))
            free[row] = known[key]
        return Holding(nodes, free)

    def shares(self, nodes: Array) -> list[Shares]:
        """Return how boundaries divide the reaction of each node."""
        known: dict[tuple[int, int], Shares] = {}
        out = []
        for n in nodes:
            if (key := self._key(n)) not in known:
                known[key] = self._divided(n)
            out.append(known[key])
        return out

    def of(self, name: str) -> Array:
        """Return which nodes a boundary holds (M,) of bool."""
        own = sum(1 << k for k, condition in enumerate(self.conditions) if condition.name == name)
        return np.asarray(self.bits & own != 0)

    def alike(self) -> Counter[tuple[str, str]]:
        """Return on how many nodes two boundaries cannot be told apart: the one that takes the reaction, the other."""
        return Counter(pair for each in self.shares(np.flatnonzero(self.bits)) for pair in each.alike)

    def _key(self, n: int) -> tuple[int, int]:
        """Return what the directions at a node depend on: its planes, and where they are not even, the node."""
        bits = int(self.bits[n])
        return bits, int(n) if bits & self.uneven else -1

    def _planes(self, n: int) -> list[int]:
        return [k for k in range(len(self.kernels)) if int(self.bits[n]) >> k & 1]

    def _held(self, k: int, n: int) -> Array:
        """Return 1 - P_k at a node (D, D)."""
        kernel = at_node(self.kernels[k], n)
        return np.eye(self.dim) - np.array([project(kernel, tuple(axis)) for axis in np.eye(self.dim)]).T

    def _divided(self, n: int) -> Shares:
        spaces: dict[str, Array] = {}
        for k in self._planes(n):
            name = self.conditions[k].name
            spaces[name] = spaces.get(name, np.zeros((self.dim, self.dim))) + self._held(k, n)
        bases = {name: _basis(space) for name, space in spaces.items()}
        carries = {c.name for c in self.conditions if getattr(c.spec, "moves", False)}
        clamps = {c.name for k in self._planes(n) if np.linalg.matrix_rank(self._held(k, n)) == self.dim
                  for c in [self.conditions[k]]}  # fmt: skip
        order = sorted(
            bases, key=lambda name: (bases[name].shape[1], name in clamps, name not in carries, self.names.index(name))
        )
        taken: dict[str, Array] = {}
        alike = []
        for name in order:
            before = np.concatenate([np.zeros((self.dim, 0)), *taken.values()], axis=1)
            taken[name], lost = _new_directions(bases[name], before)
            for other in order[: order.index(name)] if lost.size else []:
                if (name in clamps) == (other in clamps) and _overlap(lost, taken[other]):
                    alike.append((other, name))
        N = np.concatenate(list(taken.values()), axis=1)
        inverse, parts, begin = np.linalg.pinv(N), {}, 0
        for name, own in taken.items():
            parts[name] = own @ inverse[begin : begin + own.shape[1]]
            begin += own.shape[1]
        return Shares(parts, tuple(alike))


def loose_bodies(names: tuple[str, ...], body: Array, X: Array, holding: Holding) -> dict[str, int]:
    """Return the bodies that nothing holds, by name: in how many ways each can move as a rigid body.

    Args:
        names: of the bodies.
        body: the body of each node (M,).
        X: its place at rest (M, D) [m].
    """
    loose, dim = {}, X.shape[1]
    for k, name in enumerate(names):
        own = body[holding.nodes] == k
        arms = X[holding.nodes[own]] - X.mean(axis=0)
        units = np.broadcast_to(np.eye(dim), (int(own.sum()), dim, dim))
        modes = np.concatenate([units, turns(arms)], axis=2)
        ways = modes.shape[2]
        rank = 0
        if own.any():
            felt = np.einsum("nij,njr->nir", np.eye(dim) - holding.free[own], modes).reshape(-1, ways)
            size = np.linalg.norm(modes.reshape(-1, ways), axis=0)
            rank = int(np.linalg.matrix_rank(felt / np.maximum(size, 1e-300), tol=1e-8))
        if rank < ways:
            loose[name] = ways - rank
    return loose


def turns(arms: Array) -> Array:
    """Return the displacements of small turns about each axis, for arms (n, D): (n, D, 1) in 2D and (n, 3, 3) in 3D."""
    if arms.shape[1] == 2:
        return np.stack([-arms[:, 1], arms[:, 0]], axis=1)[:, :, None]
    x, y, z = arms.T
    o = np.zeros_like(x)
    return np.stack([np.stack(v, axis=1) for v in ((o, -z, y), (z, o, -x), (-y, x, o))], axis=2)


def _uneven_normals(conditions: Sequence[ConditionModel], size: Array, X: Array) -> dict[int, Array]:
    """Return the normals at nodes X (M, D) of every plane that has one for each node, by its number."""
    found = {}
    for name in dict.fromkeys(c.name for c in conditions if not isinstance(c.normal, tuple)):
        own = [k for k, condition in enumerate(conditions) if condition.name == name]
        planes = conditions[own[0]].spec.places(X, size)
        found |= {k: np.asarray(normal) for k, (_, normal) in zip(own, planes, strict=True)}
    return found


def _basis(space: Array) -> Array:
    """Return an orthonormal basis (D, m) of the range of a sum of projections."""
    U, s, _ = np.linalg.svd(space)
    return np.asarray(U[:, s > SAME])


def _span(space: Array) -> Array:
    """Return the projection on the range of a sum of projections; exact where they stand at right angles."""
    if np.abs(space @ space - space).max() < SAME and np.abs(space - space.T).max() < SAME:
        return space
    Q = _basis(space)
    return np.eye(len(space)) if Q.shape[1] == len(space) else np.asarray(Q @ Q.T)


def _new_directions(basis: Array, taken: Array) -> tuple[Array, Array]:
    """Return a basis of the directions that are not in the span of others, and one of those that are.

    The cosines of the principal angles between both are the singular values of Q^T S.
    """
    if not taken.shape[1]:
        return basis, basis[:, :0]
    Q = np.linalg.qr(taken)[0]
    _, cosines, Vt = np.linalg.svd(Q.T @ basis)
    angles = np.zeros(basis.shape[1])
    angles[: len(cosines)] = cosines
    known = angles > 1.0 - SAME
    return basis @ Vt.T[:, ~known], basis @ Vt.T[:, known]


def _overlap(a: Array, b: Array) -> bool:
    """Return whether two spaces have directions that are not at right angles."""
    return bool(a.size and b.size and np.abs(a.T @ b).max() > SAME)
