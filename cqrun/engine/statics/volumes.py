"""The tangent of averaged volumes (engine/reference/volume.py): what their mean pressures change by.

With the mean pressures kept, each particle has its own tangent (`tangent.py`). A displacement du changes the means by
V_c dJ_c = b_c . du, b_c = sum_p N_cp vol0_p cof(F_p) : grad, so the rest of the stiffness is

    sum_c U''(J_c) / V_c b_c b_c^T.

The rows b_c are a sparse matrix; a product with it costs less than a sweep over particles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from cqrun.engine.reference.corners import hats, mean_parameters
from cqrun.engine.reference.rest import stencil_weights
from cqrun.materials.term import volume_slope_vjp
from cqrun.numerics.packed import unpack
from cqrun.numerics.tensor import cofactor
from cqrun.plugin.contract import Array
from cqrun.state import state_table


class MeanVolumes:
    """The corners of all groups that have means.

    Attributes:
        rows: b_c (C, M D), sparse.
        stiffness: U'' / V of each corner (C,) [Pa / m^D].
    """

    def __init__(self, rollout: Any) -> None:
        self.rollout = rollout
        model, patches = rollout.model, rollout.rest.patches
        self.dim, self.n_nodes = model.dim, patches.n_nodes
        self.groups = [g for g, means in enumerate(rollout.means) if means]
        self.weights, self.laws = hats(rollout.rest), []
        V = np.zeros(self.n_nodes)
        for g in self.groups:
            volume, theta = mean_parameters(rollout, g)
            begin = rollout.means[g][0].begin
            V[begin : begin + len(volume)] = volume
            self.laws.append((begin, volume > 0.0, rollout.means[g][0].terms, theta))
        self.full = np.flatnonzero(V > 0.0)
        self.weights, self.volume, self.row = self.weights[self.full], V[self.full], np.cumsum(V > 0.0) - 1
        column = model.layout.columns()
        node, weight = stencil_weights(patches, column)
        offsets = np.stack(np.meshgrid(*[np.arange(3)] * self.dim, indexing="ij"), -1).reshape(-1, self.dim)
        arm = offsets[None] - patches.f[column][:, None]
        self.slope = (4.0 / model.dx) * weight[:, :, None] * arm  # (N, 3^D, D) of each node's spline
        self.place = (node[:, :, None] * self.dim + np.arange(self.dim)).reshape(len(node), -1)
        self.rows: Any = None
        self.stiffness = np.zeros(len(self.full))

    def prepare(self) -> None:
        """Find the rows and the stiffness at the state of the rollout's particles."""
        r, d = self.rollout, self.dim
        at, column, volume = state_table(d).rows["F"], r.model.layout.columns(), r.inputs.fields.volume
        F = unpack(r.bundle.q)[at][:, column]
        cof = np.array(cofactor(tuple(F))).reshape(d, d, -1)
        J = (F.reshape(d, d, -1) * cof).sum(axis=(0, 1)) / d
        each = np.einsum("p,ijp,pnj->pni", volume, cof, self.slope).reshape(len(column), -1)
        count = each.shape[1]
        begin = np.arange(0, each.size + 1, count)
        by_particle = sparse.csr_array((each.ravel(), self.place.ravel(), begin), (len(column), self.n_nodes * d))
        self.rows = sparse.csr_array(self.weights @ by_particle)
        self.rows.sort_indices()
        mean = 1.0 + self.weights @ (volume * (J - 1.0)) / self.volume
        for first, full, terms, theta in self.laws:
            own = self.row[first + np.flatnonzero(full)]
            curvature = np.zeros(len(own))
            for term, given in zip(terms, theta.values(), strict=True):
                curvature += volume_slope_vjp(term, tuple(given[:, full]), mean[own], np.ones(len(own)))[1]
            self.stiffness[own] = curvature / self.volume[own]

    def product(self, p: Array) -> Array:
        """Return this part of the stiffness times a displacement (M, D)."""
        return np.asarray(self.rows.T @ (self.stiffness * (self.rows @ p.ravel()))).reshape(p.shape)

    def add_blocks(self, blocks: Array) -> None:
        """Add to the diagonal blocks of the nodes (M, D, D)."""
        along = [self.rows[:, axis :: self.dim] for axis in range(self.dim)]
        for i, one in enumerate(along):
            for j, other in enumerate(along):
                blocks[:, i, j] += (one * other).T @ self.stiffness

    def coarse(self, P: Any) -> Any:
        """Return this part of the stiffness of coarse nodes, for the weights P (M, C) of fine nodes in them; sparse."""
        moved = self.rows @ sparse.kron(P, sparse.eye_array(self.dim), format="csr")
        return moved.T @ sparse.diags_array(self.stiffness) @ moved
