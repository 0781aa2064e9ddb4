"""Split nodes in plain Python: slow, and sharing no code with the engine.

Of the particles that a node reaches, those hang together that a chain of others joins, each at most 1.75 spacings from
the next. Each such piece has a layer of nodes of its own.
"""

from __future__ import annotations

import itertools

import numpy as np
from reference import Array

from cqrun.engine.model import Model

Offset = tuple[int, ...]


def layers(model: Model, X: Array) -> dict[Offset, Array]:
    """Return for each place of a stencil the layer of every particle's node there (N,)."""
    dim, n = model.dim, len(X)
    base = np.floor(X.real / model.dx - 0.5).astype(int)
    found = {offset: np.zeros(n, int) for offset in itertools.product(range(3), repeat=dim)}
    if model.lattice is None:
        return found
    for part, spacing in zip(model.layout.slices(), model.lattice.spacing, strict=True):
        own = np.arange(part.start, part.stop) if spacing > 0.0 else np.zeros(0, int)
        for place in {tuple(base[p] + np.array(offset)) for p in own for offset in found}:
            near = [p for p in own if ((place - base[p] >= 0) & (place - base[p] <= 2)).all()]
            for layer, piece in enumerate(pieces(near, model.lattice.x, 1.75 * spacing)):
                for p in piece:
                    found[tuple(place - base[p])][p] = layer
    return found


def pieces(particles: list[int], X: Array, reach: float) -> list[list[int]]:
    """Return the pieces of particles that hang together."""
    found, left = [], list(particles)
    while left:
        piece, new = [left[0]], [left.pop(0)]
        while new:
            here = new.pop()
            joined = [p for p in left if np.linalg.norm(X[p] - X[here]) <= reach]
            left = [p for p in left if p not in joined]
            piece, new = piece + joined, new + joined
        found.append(piece)
    return found
