"""Bodies cut from a lattice, and what is measured on them while they move."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, Model
from cqrun.state import State


def lattice(corner: list[float], size: list[float], spacing: float) -> np.ndarray:
    """Return the points of a box (N, D) [m], each in the middle of its cell of the lattice."""
    axes = [c + (np.arange(round(s / spacing)) + 0.5) * spacing for c, s in zip(corner, size, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(size))


def history(model: Model, inputs: Inputs, measure: Callable[[State], Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of all control steps [s], and what `measure` finds at each."""
    found: list[Any] = []
    make_rollout(model, inputs).run(observe=lambda step, state: found.append(measure(state)))
    return np.arange(len(found)) * model.substeps * model.dt, np.array(found)


def final(model: Model, inputs: Inputs) -> State:
    """Return the last state."""
    seen: dict[int, State] = {}
    make_rollout(model, inputs).run(observe=seen.__setitem__)
    return seen[model.n_controls]


def swing(time: np.ndarray, signal: np.ndarray, omega: float) -> tuple[float, float, float]:
    """Return (angular frequency [rad/s], damping ratio, mean) of a damped oscillation, fitted by least squares.

    Args:
        omega: a first guess of the angular frequency [rad/s].
    """
    from scipy.optimize import least_squares

    def parts(p: np.ndarray) -> np.ndarray:
        decay = np.exp(-p[1] * p[0] * time)
        w = p[0] * np.sqrt(max(1 - p[1] ** 2, 1e-6))
        return np.stack([decay * np.cos(w * time), decay * np.sin(w * time), np.ones_like(time)], 1)

    def residual(p: np.ndarray) -> np.ndarray:
        A = parts(p)
        return A @ np.linalg.lstsq(A, signal, rcond=None)[0] - signal

    fit = least_squares(residual, [omega, 0.01], x_scale=[omega, 0.01], xtol=1e-12, ftol=1e-14)
    mean = np.linalg.lstsq(parts(fit.x), signal, rcond=None)[0][2]
    return float(fit.x[0]), float(fit.x[1]), float(mean)
