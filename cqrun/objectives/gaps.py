"""Length of the gap between two points, squared or not, and its adjoint."""

from __future__ import annotations

import numpy as np

from cqrun.plugin.contract import Array


def lengths(gap: Array, squared: bool) -> Array:
    """Return |gap|^2 [m^2] or |gap| [m] (T,) of vectors (T, D)."""
    square = np.sum(gap * gap, axis=1)
    return np.asarray(square if squared else np.sqrt(square))


def lengths_vjp(gap: Array, squared: bool, h_bar: Array) -> Array:
    """Return the cotangent of the gap (T, D). At a length of 0, which is a kink, it is taken as 0."""
    if squared:
        return np.asarray(2.0 * h_bar[:, None] * gap)
    length = lengths(gap, squared=False)
    apart = length > 0
    return np.asarray(np.where(apart, h_bar, 0.0)[:, None] * gap / np.where(apart, length, 1.0)[:, None])
