"""The noise of a load cell, told from the shape of a curve."""

from __future__ import annotations

import numpy as np

from cqrun.plugin.contract import Array

WINDOWS, SHORTEST, LONGEST = 20, 7, 25
"""The noise is what a parabola leaves in a window: the curve has so many windows of these numbers of points."""


def noise_of(stress: Array) -> float:
    """Return the standard deviation of the noise of a stress (n,) that is smooth but for it; 0.0 for few points."""
    n = len(stress)
    size = int(np.clip(n // WINDOWS, SHORTEST, LONGEST))
    if n < size:
        return 0.0
    basis = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, size), 3))[0]
    windows = np.lib.stride_tricks.sliding_window_view(stress, size)[:: max(1, size // SHORTEST)]
    left = windows - (windows @ basis) @ basis.T
    return float(np.sqrt(np.median((left**2).sum(axis=1)) / (size - 3)))
