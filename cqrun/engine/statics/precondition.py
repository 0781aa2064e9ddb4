"""The preconditioner of equilibria: blocks of nodes, volumes, and a coarse space where blocks alone are slow.

It is the sum of two inverses: that of every node's D x D block, with averaged volumes beside it (incompressible.py),
and that of the coarse stiffness (coarse.py), from the first linear system that takes long.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.engine.statics.coarse import CoarseSpace, pulled_points
from cqrun.engine.statics.holding import Holding
from cqrun.engine.statics.incompressible import MOST_CORNERS, Squeeze
from cqrun.engine.statics.tangent import add_blocks
from cqrun.engine.statics.touching import StillContact
from cqrun.engine.statics.volumes import MeanVolumes
from cqrun.plugin.contract import Array

MANY = 200_000
"""With more nodes the coarse space would take too much memory."""

REFRESH = 200
"""Products after which the coarse space is made, or made anew: it is about as dear as they are."""

LEAST_BLOCK = 1e-3
"""Least eigenvalue of a node's block, as a part of the block's largest."""


class Preconditioner:
    """The inverse of something like the stiffness matrix, for one equilibrium.

    Args:
        rollout: of the reference frame, with nodes, particles, ghost penalty and forces on points.
        A: the tangents of all particles (`tangent.py`).
        holding: what boundaries leave free.
        volumes: averaged volumes, or none.
        control: the control step whose activations act.
        slow: whether the coarse space is made at once, because equilibria like this one needed it.
        contact: what bodies touch, or none.

    Attributes:
        coarse: the coarse space, once there is one.
        since: products since the coarse space was made; before, since the beginning.
    """

    def __init__(
        self, rollout: Any, A: Array, holding: Holding, volumes: MeanVolumes | None, control: int, *, slow: bool,
        contact: StillContact | None = None,
    ) -> None:  # fmt: skip
        self.contact = contact
        self.rollout, self.A, self.holding, self.volumes = rollout, A, holding, volumes
        self.run, self.dim, self.control = rollout.bundle, rollout.model.dim, control
        self.active = self.run.nodes.active
        self.inverse = np.zeros((0, self.dim, self.dim))
        self.squeezes = volumes is not None and len(volumes.full) <= MOST_CORNERS
        self.squeeze: Squeeze | None = None
        self.coarse: CoarseSpace | None = None
        self.since = REFRESH + 1 if slow else 0

    @property
    def size(self) -> int:
        """Its size in memory [bytes]."""
        return sum(each.size for each in (self.coarse, self.squeeze) if each is not None)

    @property
    def fresh(self) -> bool:
        """Whether the coarse space was made after the last product."""
        return self.coarse is not None and self.since == 0

    def prepare(self) -> None:
        """Find it at the state of the tangents; a coarse space that has served for long is made anew."""
        blocks = self._blocks()
        lower = np.tril(blocks, -1)
        values, vectors = np.linalg.eigh(blocks + lower.transpose(0, 2, 1))
        values = np.maximum(np.abs(values), LEAST_BLOCK * np.abs(values).max(axis=1, keepdims=True))
        self.inverse = np.einsum("nij,nj,nkj->nik", vectors, 1.0 / values, vectors)
        if self.volumes is not None and self.squeezes:
            self.squeeze = Squeeze(self.volumes, self._free_inverse(), self.active)
        if self.since > REFRESH:
            self.add_coarse()

    def solve(self, r: Array) -> Array:
        """Return its product with forces (M, 4), which have no part along what boundaries hold."""
        z, dim = np.zeros_like(r), self.dim
        z[self.active, :dim] = np.einsum("nij,nj->ni", self.inverse, r[self.active, :dim])
        z = self.holding.freed(z)
        if self.squeeze is not None:
            z[:, :dim] += self.squeeze.change(z[:, :dim])
        if self.coarse is not None and self.coarse.ready:
            z += self.coarse.solve(r)
        return z

    def add_coarse(self) -> bool:
        """Make the coarse space at the state of the tangents; return whether the stiffness there is positive."""
        if len(self.active) > MANY:
            return True
        r, patches = self.rollout, self.rollout.rest.patches
        if self.coarse is None:
            free = np.ones(patches.n_nodes, bool)
            free[self.holding.nodes] = False
            self.coarse = CoarseSpace(self.run, patches, free)
        self.since = 0
        pulled = pulled_points(self.run, r.loads, r.drive, self.control)
        return self.coarse.prepare(self.A, r.ghosts, pulled, self.volumes)

    def smallest(self) -> float:
        """Return the smallest eigenvalue of the stiffness relative to the blocks, in the coarse space; NaN without one.

        It is an upper bound of the fine one's, and negative where the equilibrium is not stable.
        """
        self.add_coarse()
        if self.coarse is None or not self.coarse.moves:
            return float("nan")
        return self.coarse.smallest(np.linalg.inv(self.inverse), self.active)

    def _blocks(self) -> Array:
        """Return the diagonal block of every active node (A, D, D), without the volumes that `squeeze` knows."""
        blocks = np.zeros((self.rollout.rest.patches.n_nodes, self.dim, self.dim))
        add_blocks(self.run, self.A, blocks, 0, self.rollout.rest.patches.layout.n)
        if self.volumes is not None and not self.squeezes:
            self.volumes.add_blocks(blocks)
        for ghost in self.rollout.ghosts:
            scale = np.add.reduceat(ghost.factor**2 * ghost.scale[ghost.runs], ghost.begin[:-1])
            blocks[ghost.nodes[:, None], np.arange(self.dim), np.arange(self.dim)] += scale[:, None]
        if self.contact is not None:
            self.contact.add_blocks(blocks)
        return np.asarray(blocks[self.active])

    def _free_inverse(self) -> Array:
        """Return the inverse of the active nodes' blocks between the directions that are free (A, D, D)."""
        P = np.tile(np.eye(self.dim), (self.rollout.rest.patches.n_nodes, 1, 1))
        P[self.holding.nodes] = self.holding.free
        P = P[self.active]
        return np.asarray(P @ self.inverse @ P)
