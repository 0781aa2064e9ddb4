"""The edges of a triangle surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class Edges:
    """The edges of a surface of T faces.

    Attributes:
        at: (T, 3) index of the edge at each side of each face.
        ends: (E, 2) indices of its vertices, the lower one first.
        faces: (E,) number of faces that meet there.
        excess: (E,) how many more of them pass it from the first end to the second than the other way; all zero if the
            surface is closed.
    """

    at: Array
    ends: Array
    faces: Array
    excess: Array

    @classmethod
    def of(cls, faces: Array) -> Edges:
        """Return the edges of faces (T, 3), which are indices of vertices."""
        sides = faces[:, [[0, 1], [1, 2], [2, 0]]]
        low, high = sides.min(axis=2), sides.max(axis=2)
        stride = int(faces.max()) + 1
        keys, at, count = np.unique(low * stride + high, return_inverse=True, return_counts=True)
        forward = np.where(sides[..., 0] == low, 1.0, -1.0)
        excess = np.bincount(at.ravel(), forward.ravel()).astype(int)
        return cls(at.reshape(-1, 3), np.stack(np.divmod(keys, stride), axis=1), count, excess)

    def pieces(self, by: Array) -> Array:
        """Return the number of the piece (T,) to which each face belongs; edges with `by` (E,) connect faces."""
        face, edge = np.repeat(np.arange(len(self.at)), 3), self.at.ravel()
        joined = by[edge]
        n = len(self.at) + len(self.ends)
        graph = csr_array((np.ones(joined.sum()), (face[joined], len(self.at) + edge[joined])), (n, n))
        labels = connected_components(graph, directed=False)[1][: len(self.at)]
        return np.unique(labels, return_inverse=True)[1]
