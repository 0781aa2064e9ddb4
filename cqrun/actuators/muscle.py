"""Muscle: an active stress in material space, tau = F S F^T (CQ1, P = P_el + F S).

S is symmetric: S = a s n n^T for an axis n, strength s [Pa] and activation a, and S = a s I for `isotropic`. A positive
activation is a tension, which contracts the body along the axis. The papers call F S F^T a Cauchy stress; but it is
multiplied by the rest volume, so it is a Kirchhoff stress and S a second Piola-Kirchhoff stress.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import overload

from cqrun.actuators.actuator import DirectedStress
from cqrun.materials.term import register, zeros_like_rows
from cqrun.numerics.tensor import add, mul, mul_at, mul_bt, symmetric
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class MuscleKernel(NamedTuple):
    """Kernels' view: rows S_ij (D * (D + 1) / 2, diagonal first) [Pa], filled from the activations."""

    theta: Array
    rows: tuple[int, ...]


@plugin("actuator", "muscle")
class Muscle(DirectedStress):
    """Active stress tau = F S F^T, S = activation strength n n^T along an axis n, or times I if isotropic.

    A positive activation contracts the body along the axis; a negative one stretches it, as in the papers.
    """

    strength: float = quantity("Pa", "Active stress at activation 1", differentiable=True, ge=0)

    scale = "strength"
    kernel = MuscleKernel

    def constants(self, x: Array) -> Array:
        """Return S / (activation strength) as rows (D (D + 1) / 2,)."""
        return symmetric_rows(self.direction(x.shape[1]))


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    return mul_bt(mul(F, from_rows(theta)), F)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    S = from_rows(theta)
    F_bar = mul(add(mul(tau_bar, F), mul_at(tau_bar, F)), S)
    return to_rows_vjp(symmetric(mul(mul_at(F, tau_bar), F))), F_bar, zeros_like_rows(F)


def symmetric_rows(S: Array) -> Array:
    """Return the rows (D (D + 1) / 2,) of a symmetric matrix (D, D): diagonal first, then 01 (02 12)."""
    pairs = [(0, 1)] if len(S) == 2 else [(0, 1), (0, 2), (1, 2)]
    return np.array([*np.diag(S), *(S[i, j] for i, j in pairs)])


_FROM = {
    3: lambda s: (s[0], s[2], s[2], s[1]),
    6: lambda s: (s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2]),
}
_TO = {
    4: lambda S_bar: (S_bar[0], S_bar[3], S_bar[1] * 2.0),
    9: lambda S_bar: (S_bar[0], S_bar[4], S_bar[8], S_bar[1] * 2.0, S_bar[2] * 2.0, S_bar[5] * 2.0),
}


def from_rows(s: Any) -> Any:
    """Return the full symmetric matrix with these rows."""
    return _FROM[len(s)](s)


def to_rows_vjp(S_bar: Any) -> Any:
    """Return the cotangents of the rows for a symmetric S_bar: an off-diagonal row counts twice."""
    return _TO[len(S_bar)](S_bar)


@overload(from_rows)
def _from_rows(s):
    return _FROM[len(s)]


@overload(to_rows_vjp)
def _to_rows_vjp(S_bar):
    return _TO[len(S_bar)]


register(MuscleKernel, stress, stress_vjp, rate=False)
