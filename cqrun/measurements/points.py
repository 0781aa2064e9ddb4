"""Markers: points, possibly on stems, that move rigidly with the part of a body where they are attached.

y = x_f + R_f s, with the foot x_f, the stem s at rest, and the rotation R_f of the deformation gradient
at the foot. For the velocity, the spin of the foot is the skew part of C_f. The velocity is used only
for interpolation between control steps, where the contribution of strain to the spin is second order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cqrun.engine.model import Records
from cqrun.measurements import binding
from cqrun.measurements.rotation import rotation, rotation_vjp
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True)
class Points:
    """Points that are observed through particles: with stems (markers) or without (tracked particles).

    Attributes:
        rows: sparse (M, N): weights of the body's particles for each point; every row sums to 1.
        stems: (M, D) at rest [m]; None if all are zero, so that F and C do not matter.
    """

    rows: csr_array
    stems: Array | None = None

    def observe(self, record: Records) -> tuple[Array, Array]:
        """Return positions [m] and velocities [m/s] of the points, both (T+1, M, D)."""
        if self.stems is None:
            return record.x, record.v
        arm = _apply(rotation(record.F), self.stems)
        return record.x + arm, record.v + _apply(_skew(record.C), arm)

    def observe_vjp(self, record: Records, y_bar: Array, w_bar: Array) -> Records:
        """Return the cotangent of `record` from those of positions and velocities, both (T+1, M, D)."""
        if self.stems is None:
            return Records(y_bar, w_bar, np.zeros(np.shape(record.C)), np.zeros(np.shape(record.F)))
        R = rotation(record.F)
        arm, spin = _apply(R, self.stems), _skew(record.C)
        arm_bar = y_bar - _apply(spin, w_bar)  # spin^T = -spin
        C_bar = _skew(w_bar[..., :, None] * arm[..., None, :])
        R_bar = arm_bar[..., :, None] * self.stems[:, None, :]
        return Records(y_bar, w_bar, C_bar, rotation_vjp(record.F, R, R_bar))


def markers(rest: Array, particles: Array, spacing: float) -> Points:
    """Return the observer of markers on a body, both at rest: (M, D) and its particles (N, D) [m]."""
    bound = binding.bind(rest, particles, spacing)
    return Points(bound.rows, bound.stems)


def particles(indices: Array, count: int) -> Points:
    """Return the observer of the particles `indices` of a body of `count`."""
    return Points(binding.pick(indices, count))


def _apply(A: Array, a: Array) -> Array:
    """Return A a for arrays of matrices (..., D, D) and vectors (..., D)."""
    return np.asarray((A @ a[..., None])[..., 0])


def _skew(A: Array) -> Array:
    return np.asarray(0.5 * (A - np.swapaxes(A, -1, -2)))
