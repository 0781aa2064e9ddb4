"""Slack at the start of a pull (toe): the strain at which the specimen is taut.

Rubber in tension softens from rest, so every tangent near the start meets zero stress at a strain of zero or below.
If the steepest one meets it at a positive strain, the grips have moved before the specimen was pulled (ASTM D638, annex
A1).
"""

from __future__ import annotations

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.tensile.noise import noise_of

SMALLEST, LARGEST = 0.005, 0.10
"""Slack below the first strain is not corrected; from the second on it may be the material's shape."""

WINDOW, FEWEST = 0.05, 4
"""Smallest width of a tangent's window in strain, and the fewest points in it."""

NEAR, NEAR_PART = 0.5, 0.3
"""The start: up to this strain, and up to this part of the largest."""

SURE, SURE_OF_NOISE = 3.0, 5.0
"""The slack is so many standard errors above zero: by what the tangent misses, and by the noise of the whole curve, of
which the steepest tangent is the worst case."""

PRECISE = 0.05
"""A window is so wide that noise changes the slope by this part."""


def find_slack(strain: Array, stress: Array) -> float:
    """Return the strain at which a pulled specimen is taut; 0.0 if it is from the start, or if that is uncertain.

    A strain of LARGEST or more may also be the material's shape.

    Args:
        strain, stress: (n,) of the first loading.
    """
    near = strain <= min(NEAR, NEAR_PART * float(strain.max()))
    x, y, noise = strain[near], stress[near], noise_of(stress)
    window = _window(x, y, noise)
    steepest, taut, error = 0.0, 0.0, np.inf
    for first in range(len(x) - FEWEST + 1):
        last = max(first + FEWEST, int(np.searchsorted(x, x[first] + window)))
        is_short = first > 0 and last - first > FEWEST and x[first] + window > x[-1]
        if last > len(x) or is_short:
            break
        u, v = x[first:last], y[first:last]
        spread = float(((u - u.mean()) ** 2).sum())
        if spread == 0.0:
            continue
        slope = float((u - u.mean()) @ v) / spread
        if slope > steepest:
            steepest, taut = slope, float(u.mean() - v.mean() / slope)
            scatter = np.sqrt(((v - v.mean() - slope * (u - u.mean())) ** 2).sum() / (len(u) - 2))
            reach = np.sqrt(1.0 / len(u) + (u.mean() - taut) ** 2 / spread) / slope
            error = max(SURE * scatter, SURE_OF_NOISE * noise) * reach
    return taut if taut > max(SMALLEST, error) else 0.0


def _window(strain: Array, stress: Array, noise: float) -> float:
    """Return the width of a tangent's window in strain, for points (n,) near the start and their noise."""
    length = float(np.ptp(strain)) if len(strain) else 0.0
    slope = float(np.polyfit(strain, stress, 1)[0]) if length > 0.0 else 0.0
    if slope <= 0.0:
        return WINDOW
    needed = (12.0 * (noise / (PRECISE * slope)) ** 2 * length / len(strain)) ** (1 / 3)
    return max(WINDOW, min(needed, 0.5 * length))
