"""Numerical fracture: particles that were neighbours at rest and no longer talk through the grid.

A particle reaches the 3 nodes along each axis around it. Two particles act on each other only while they share a
node, that is while their stencils are at most 2 nodes apart along every axis. A body stretched beyond that falls
apart whatever its material says, so the pairs that are lost are counted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array

NEAR = 1.5
"""Neighbours are closer than this many times the particles' spacing: those along the axes and, in a plane, across."""

REACH = 2
"""Distance of two stencils, in nodes, up to which they share one."""


@dataclass
class Fracture:
    """The neighbours of each body, and the most that were lost so far.

    Attributes:
        pairs: by body, indices of neighbours at rest (P, 2) that share a node then.
        dx: edge of a cell [m].
        most: by body, the greatest number of pairs lost at one time.
    """

    pairs: dict[str, Array]
    dx: float
    most: dict[str, int]

    @classmethod
    def of(cls, x: Array, bodies: Mapping[str, slice], spacing: Mapping[str, float], dx: float) -> Fracture:
        """Find the neighbours.

        Args:
            x: particles at rest (N, D) [m].
            bodies: each body's slice of them.
            spacing: distance between the particles of each body [m].
            dx: edge of a cell [m].
        """
        from scipy.spatial import cKDTree

        pairs = {}
        for name, part in bodies.items():
            found = cKDTree(x[part]).query_pairs(NEAR * spacing[name], output_type="ndarray") + part.start
            pairs[name] = found[~_apart(x, found, dx)]
        return cls(pairs, dx, dict.fromkeys(pairs, 0))

    def count(self, x: Array) -> dict[str, int]:
        """Return how many pairs of each body share no node at x (N, D), and remember the most."""
        lost = {name: int(np.count_nonzero(_apart(x, found, self.dx))) for name, found in self.pairs.items()}
        self.most = {name: max(self.most[name], number) for name, number in lost.items()}
        return lost

    def findings(self) -> list[str]:
        """Return a sentence for each body that came apart."""
        return [
            f"numerical fracture: {number} of {len(self.pairs[name])} neighbouring particles of the body '{name}' "
            "came so far apart that they shared no grid node, so the body tears there whatever its material; "
            "use more particles per cell, or a softer load"
            for name, number in self.most.items()
            if number
        ]


def _apart(x: Array, pairs: Array, dx: float) -> Array:
    """Say which pairs (P, 2) share no node at x (N, D)."""
    base = np.floor(x / dx - 0.5)
    return np.asarray((np.abs(base[pairs[:, 0]] - base[pairs[:, 1]]) > REACH).any(axis=1))
