"""Numerical fracture: particles that were neighbours at rest and no longer share a grid node.

A particle exchanges momentum with 3 nodes along each axis. Two particles act on each other only while they share a
node, which means that their stencils are at most 2 nodes apart along every axis. A body that is stretched beyond that
tears, whatever its material law. This module counts the pairs that are lost.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array

NEAR = 1.5
"""Neighbours are closer than this many particle spacings: next to each other along an axis or a face diagonal."""

REACH = 2
"""Largest distance of two stencils, in nodes, at which they share a node."""


@dataclass
class Fracture:
    """The pairs of neighbours in each body, and the largest number of pairs lost so far.

    Attributes:
        pairs: body -> indices (P, 2) of neighbours at rest that share a node at rest.
        dx: edge of a cell [m].
        most: body -> the largest number of pairs lost at one time.
    """

    pairs: dict[str, Array]
    dx: float
    most: dict[str, int]

    @classmethod
    def of(cls, x: Array, bodies: Mapping[str, slice], spacing: Mapping[str, float], dx: float) -> Fracture:
        """Find the pairs of neighbours at rest.

        Args:
            x: particles at rest (N, D) [m].
            bodies: each body's slice of them.
            spacing: distance between the particles of each body [m].
            dx: edge of a cell [m].
        """
        from scipy.spatial import cKDTree

        pairs = {}
        for name, part in bodies.items():
            near = cKDTree(x[part]).query_pairs(NEAR * spacing[name], output_type="ndarray") + part.start
            pairs[name] = near[~_apart(x, near, dx)]
        return cls(pairs, dx, dict.fromkeys(pairs, 0))

    def count(self, x: Array) -> dict[str, int]:
        """Return how many pairs of each body share no node at x (N, D), and update `most`."""
        lost = {name: int(np.count_nonzero(_apart(x, pairs, self.dx))) for name, pairs in self.pairs.items()}
        self.most = {name: max(self.most[name], number) for name, number in lost.items()}
        return lost

    def findings(self) -> list[str]:
        """Return a sentence for each body that came apart."""
        return [
            f"numerical fracture: {number} of {len(self.pairs[name])} neighbouring particles of the body '{name}' "
            "came so far apart that they shared no grid node, so the body tears there whatever its material; "
            "use more particles per cell, a softer load, or `world.frame: reference`, in which no body tears"
            for name, number in self.most.items()
            if number
        ]


def _apart(x: Array, pairs: Array, dx: float) -> Array:
    """Return which pairs (P, 2) share no node at x (N, D): (P,) bool."""
    base = np.floor(x / dx - 0.5)
    return np.asarray((np.abs(base[pairs[:, 0]] - base[pairs[:, 1]]) > REACH).any(axis=1))
