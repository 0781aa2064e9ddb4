"""Fit a damped oscillation to a signal, without a Fourier transform: the window need not hold whole periods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class Oscillation:
    """mean + exp(-ratio w t) (a cos(w' t) + b sin(w' t)), with w = 2 pi frequency and w' = w sqrt(1 - ratio^2).

    Attributes:
        frequency: the undamped frequency [Hz].
        damping_ratio: the part of critical damping; negative for a swing that grows.
        mean: the value about which the signal swings.
        amplitude: the amplitude at time 0.
        residual: root mean square of the rest, over the amplitude.
    """

    frequency: float
    damping_ratio: float
    mean: float
    amplitude: float
    residual: float


def fit_oscillation(time: Array, signal: Array, frequency: float) -> Oscillation:
    """Fit by least squares; the mean and both amplitudes are linear and are eliminated (variable projection).

    Args:
        time: times (T,) [s].
        signal: values (T,).
        frequency: a first guess [Hz], within about a third of a period over the window.

    Raises:
        ValueError: the signal is shorter than a period of the guess, or is not finite.
    """
    if not np.isfinite(signal).all() or np.ptp(time) * frequency < 1.0:
        raise ValueError("the signal must be finite and at least one period long")

    def basis(p: Array) -> Array:
        w, decay = 2.0 * np.pi * p[0] * frequency, np.exp(-p[1] * 2.0 * np.pi * p[0] * frequency * time)
        turn = w * np.sqrt(max(1.0 - p[1] ** 2, 1e-6)) * time
        return np.stack([np.ones_like(time), decay * np.cos(turn), decay * np.sin(turn)], 1)

    def amplitudes(p: Array) -> Array:
        return np.asarray(np.linalg.lstsq(basis(p), signal, rcond=None)[0])

    def rest(p: Array) -> Array:
        return np.asarray((basis(p) @ amplitudes(p) - signal) / np.std(signal))

    bounds = ([0.2, -0.9], [5.0, 0.9])
    found = least_squares(rest, [1.0, 0.0], x_scale=[1.0, 0.1], bounds=bounds, xtol=1e-14, ftol=1e-14)
    mean, a, b = amplitudes(found.x)
    size = float(np.hypot(a, b))
    error = float(np.sqrt(np.mean(found.fun**2)) * np.std(signal) / size)
    return Oscillation(float(found.x[0] * frequency), float(found.x[1]), float(mean), size, error)
