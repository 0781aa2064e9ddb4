"""The deformation of a body as its particles' positions tell it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cqrun.plugin.contract import Array

NEIGHBOURS = {2: 12, 3: 40}
"""Particles whose motion gives the deformation of the one between them; enough for lattices that are finer one way."""

FLAT = 1e-6
"""Neighbours in one line or plane, to this part of their extent, do not tell the deformation."""


class Strain:
    """Green's strain of every particle, from positions alone: F maps its neighbours from rest to where they are.

    F is the least-squares fit of dx = F dX over the nearest particles of the same body at rest, weighted by 1 / |dX|^2.

    Args:
        rest: positions of the undeformed bodies (N, D) [m].
        bodies: slice of each.
    """

    def __init__(self, rest: Array, bodies: Mapping[str, slice]) -> None:
        from scipy.spatial import cKDTree

        self.dim = rest.shape[1]
        self._parts: list[tuple[slice, Array, Array, Array]] = []
        for part in bodies.values():
            own = rest[part]
            count = min(NEIGHBOURS[self.dim], len(own) - 1)
            if count < self.dim:
                continue
            near = cKDTree(own).query(own, k=count + 1)[1][:, 1:]
            arms = own[near] - own[:, None]
            weighted = arms / np.maximum(np.sum(arms**2, axis=2, keepdims=True), 1e-300)
            moment = np.einsum("nki,nkj->nij", weighted, arms)
            extent = np.linalg.eigvalsh(moment)
            told = extent[:, 0] > FLAT * extent[:, -1]
            moment[~told] = np.eye(self.dim)
            self._parts.append((part, near, np.einsum("nki,nij->nkj", weighted, np.linalg.inv(moment)), told))

    def gradient(self, x: Array) -> Array:
        """Return F (N, D, D) at positions x (N, D); NaN where too few neighbours tell it."""
        F = np.full((len(x), self.dim, self.dim), np.nan)
        for part, near, weights, told in self._parts:
            own = x[part]
            fitted = np.einsum("nki,nkj->nij", own[near] - own[:, None], weights)
            fitted[~told] = np.nan
            F[part] = fitted
        return F


def green_norm(F: Array) -> Array:
    """Return |E| = sqrt(E : E) of Green's strain E = (F^T F - I) / 2 (N,), from F (N, D, D)."""
    E = 0.5 * (np.einsum("nki,nkj->nij", F, F) - np.eye(F.shape[1]))
    return np.asarray(np.sqrt(np.einsum("nij,nij->n", E, E)))
