"""Winding numbers of a triangle surface."""

from __future__ import annotations

import numpy as np

from cqrun.plugin.contract import Array


def winding_numbers(vertices: Array, faces: Array, points: Array) -> Array:
    """Return how often a surface winds around points (N, 3): (N,), 1 inside a closed one and 0 outside."""
    import igl

    return np.asarray(igl.fast_winding_number(vertices, faces, np.ascontiguousarray(points, float)))
