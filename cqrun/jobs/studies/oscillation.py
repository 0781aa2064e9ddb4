"""Find the frequency of a motion that oscillates: the best damped sine, by least squares."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from cqrun.plugin.contract import Array

PERIODS = 2.0
"""Smallest number of periods in a motion that oscillates."""

SAMPLES = 5.0
"""Smallest number of samples in a period."""

EXPLAINED = 0.9
"""Smallest part of the variance that the damped sine must explain."""

DAMPED = 1.5
"""Largest logarithm of the factor by which the amplitude may fall in a period."""


def frequency(time: Array, y: Array) -> float | None:
    """Return the frequency of y(t) [Hz]: that of c + exp(-a t) (A cos w t + B sin w t) with the least squares.

    Args:
        time: equally spaced times (T,) [s].
        y: a coordinate at these times (T,).

    Returns:
        None if the motion does not oscillate: the fit explains less than 90 % of the variance, there are fewer than two
        periods or five samples a period, or the amplitude falls by more than a factor of 4.5 a period.
    """
    span = float(time[-1] - time[0]) if len(time) else 0.0
    if len(time) < PERIODS * SAMPLES or span <= 0 or not np.isfinite(y).all() or np.ptp(y) <= 0:
        return None
    t, centred = (time - time[0]) / span, (y - y.mean()) / y.std()
    spectrum = np.abs(np.fft.rfft(centred, 8 * len(t)))
    turns = np.fft.rfftfreq(8 * len(t), t[1] - t[0])
    possible = (turns >= 0.5 * PERIODS) & (turns <= len(t) / SAMPLES)
    if not possible.any():
        return None
    guess = float(turns[possible][np.argmax(spectrum[possible])])

    def rest(p: Array) -> Array:
        decay, angle = np.exp(-p[0] * t), 2.0 * np.pi * p[1] * t
        basis = np.stack([np.ones_like(t), decay * np.cos(angle), decay * np.sin(angle)], axis=1)
        return np.asarray(centred - basis @ np.linalg.lstsq(basis, centred, rcond=None)[0])

    fit = least_squares(rest, [0.1, guess], bounds=([-1.0, 0.6 * guess], [DAMPED * 2.0 * guess, 1.5 * guess]))
    damping, count = map(float, fit.x)
    explained = 1.0 - 2.0 * float(fit.cost) / float(centred @ centred)
    if explained < EXPLAINED or not PERIODS <= count <= len(t) / SAMPLES or damping > DAMPED * count:
        return None
    return count / span
