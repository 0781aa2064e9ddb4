"""Values between control steps: cubic Hermite or linear interpolation of a rollout's records, and its adjoint.

The interpolant is continuously differentiable in the sample times, so a start time that is an unknown has a gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

SLACK = 1e-3
"""Sample times may exceed the rollout's end by this part of a control step, as decimal times are rounded."""


@dataclass(frozen=True)
class Interpolant:
    """Sparse weights of T+1 control steps for F sample times: y(tau) = values @ y + tangents @ w.

    Attributes:
        values, tangents: (F, T+1), for positions [1] and velocities [s].
        value_slopes, tangent_slopes: (F, T+1), their derivatives by tau.
    """

    values: csr_matrix
    tangents: csr_matrix
    value_slopes: csr_matrix
    tangent_slopes: csr_matrix

    def __call__(self, y: Array, w: Array) -> Array:
        """Return positions (F, M, D) [m] from positions and velocities at the control steps, (T+1, M, D)."""
        return _apply(self.values, y) + _apply(self.tangents, w)

    def slope(self, y: Array, w: Array) -> Array:
        """Return the derivative of the positions by tau (F, M, D) [m/s]; 0 before the release."""
        return _apply(self.value_slopes, y) + _apply(self.tangent_slopes, w)

    def vjp(self, out_bar: Array) -> tuple[Array, Array]:
        """Return the cotangents of y and w, both (T+1, M, D), from that of the positions."""
        return _apply(self.values.T, out_bar), _apply(self.tangents.T, out_bar)


def interpolant(tau: Array, control_step: float, steps: int) -> Interpolant:
    """Return the cubic interpolant at times tau (F,) after the release [s], for a rollout of `steps` control steps.

    Before the release (tau < 0) the model rests at its initial positions.

    Raises:
        ValueError: a time is after the rollout's end.
    """
    index, s, moving = _place(tau, control_step, steps)
    dt = control_step
    late = s * s * (3 - 2 * s)
    rise = moving * 6 * s * (1 - s) / dt
    return Interpolant(
        _weights(index, steps, 1 - late, late),
        _weights(index, steps, dt * s * (1 - s) ** 2, dt * s * s * (s - 1)),
        _weights(index, steps, -rise, rise),
        _weights(index, steps, moving * (1 - s) * (1 - 3 * s), moving * s * (3 * s - 2)),
    )


def linear(tau: Array, control_step: float, steps: int) -> Interpolant:
    """Return the linear interpolant, which uses no velocities; arguments and errors as `interpolant`."""
    index, s, moving = _place(tau, control_step, steps)
    none, rise = _weights(index, steps, 0 * s, 0 * s), moving / control_step
    return Interpolant(_weights(index, steps, 1 - s, s), none, _weights(index, steps, -rise, rise), none)


def _place(tau: Array, control_step: float, steps: int) -> tuple[Array, Array, Array]:
    """Return the control step before each time, which part of the step has passed, and 0 where the model rests."""
    if np.any(tau > (steps + SLACK) * control_step):
        raise ValueError(f"sample at {np.max(tau):.9g} s, after the rollout's end at {steps * control_step:.9g} s")
    place = np.clip(tau / control_step, 0.0, steps)
    index = np.minimum(place.astype(int), steps - 1)
    return index, place - index, (tau >= 0).astype(float)


def _weights(index: Array, steps: int, first: Array, second: Array) -> csr_matrix:
    """Return the matrix (F, steps + 1) of the weights of the control steps before and after each time."""
    from scipy.sparse import csr_matrix

    columns = np.stack([index, index + 1], 1).ravel()
    starts = 2 * np.arange(len(index) + 1)
    return csr_matrix((np.stack([first, second], 1).ravel(), columns, starts), shape=(len(index), steps + 1))


def _apply(weights: csr_matrix, field: Array) -> Array:
    """Return weights @ field for a field (T, M, D)."""
    return np.asarray(weights @ field.reshape(len(field), -1)).reshape(weights.shape[0], *field.shape[1:])
