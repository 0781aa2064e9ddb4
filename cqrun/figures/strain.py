"""Compute the strain of a body from the positions of its particles."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cqrun.plugin.contract import Array

NEIGHBOURS = {2: 12, 3: 40}
"""Number of neighbours from which a deformation gradient is fitted; enough for lattices finer in one direction."""

FLAT = 1e-6
"""If neighbours are in one line or plane, to this part of their extent, the deformation gradient is unknown."""


class Strain:
    """The deformation gradient F of every particle, from positions only.

    F is the least-squares fit of dx = F dX over the nearest particles of the same body at rest, weighted by 1 / |dX|^2.

    Args:
        rest: positions of the undeformed bodies (N, D) [m].
        bodies: slice of each body's particles.
    """

    def __init__(self, rest: Array, bodies: Mapping[str, slice]) -> None:
        from scipy.spatial import cKDTree

        self.dim = rest.shape[1]
        self._parts: list[tuple[slice, Array, Array, Array]] = []
        for part in bodies.values():
            x_rest = rest[part]
            count = min(NEIGHBOURS[self.dim], len(x_rest) - 1)
            if count < self.dim:
                continue
            near = cKDTree(x_rest).query(x_rest, k=count + 1)[1][:, 1:]
            arms = x_rest[near] - x_rest[:, None]
            weighted = arms / np.maximum(np.sum(arms**2, axis=2, keepdims=True), 1e-300)
            moment = np.einsum("nki,nkj->nij", weighted, arms)
            extent = np.linalg.eigvalsh(moment)
            known = extent[:, 0] > FLAT * extent[:, -1]
            moment[~known] = np.eye(self.dim)
            self._parts.append((part, near, np.einsum("nki,nij->nkj", weighted, np.linalg.inv(moment)), known))

    def gradient(self, x: Array) -> Array:
        """Return F (N, D, D) at positions x (N, D); NaN for particles with too few neighbours."""
        F = np.full((len(x), self.dim, self.dim), np.nan)
        for part, near, weights, known in self._parts:
            x_body = x[part]
            fitted = np.einsum("nki,nkj->nij", x_body[near] - x_body[:, None], weights)
            fitted[~known] = np.nan
            F[part] = fitted
        return F


def green_norm(F: Array) -> Array:
    """Return |E| = sqrt(E : E) of Green's strain E = (F^T F - I) / 2 (N,), from F (N, D, D)."""
    E = 0.5 * (np.einsum("nki,nkj->nij", F, F) - np.eye(F.shape[1]))
    return np.asarray(np.sqrt(np.einsum("nij,nij->n", E, E)))
