"""Muscle: an active stress in material space, tau = F S F^T (CQ1, P = P_el + F S).

S is symmetric: S = a s n n^T for an axis n, strength s [Pa] and activation a, and S = a s I for `isotropic`. A positive
activation is a tension, which contracts the body along the axis. The papers call F S F^T a Cauchy stress; but it is
multiplied by the rest volume, so it is a Kirchhoff stress and S a second Piola-Kirchhoff stress.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.actuators.actuator import DirectedStress
from cqrun.materials.term import register, zeros_like_rows
from cqrun.numerics.symmetric import from_rows, symmetric_rows, to_rows_vjp
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


register(MuscleKernel, stress, stress_vjp, rate=False)
