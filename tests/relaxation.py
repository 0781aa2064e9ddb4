"""A material term with history, as a plug-in file of a scene's own: a stress that relaxes.

One number h of each particle follows the strain e = |F|^2 / 2 with the relaxation time t, by the backward Euler rule

    h' = (t h + dt e(F)) / (t + dt),

and the stress is tau = G (e - h) F F^T: none at rest, and none where h has caught up.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from cqrun.materials.term import MaterialTerm, register_with_history, zeros_like_rows
from cqrun.numerics.tensor import add, inner, mul, mul_bt, scale, symmetric
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin
from cqrun.state import StateField


class RelaxationKernel(NamedTuple):
    """What kernels see: rows G [Pa], t [s]; the history is one row of the state."""

    theta: Array
    rows: tuple[int, int]
    history: tuple[int, ...]


@plugin("material_term", "relaxation")
class Relaxation(MaterialTerm):
    """A stress tau = G (e - h) F F^T that relaxes as h follows the strain e."""

    parameters: ClassVar[tuple[str, ...]] = ("modulus", "time")
    modulus: float = quantity("Pa", "Modulus G", differentiable=True, ge=0)
    time: float = quantity("s", "Relaxation time t", differentiable=True, gt=0)

    def kernel_term(self, theta: Array) -> RelaxationKernel:
        return RelaxationKernel(theta, (0, 0), ())

    def history(self, dim: int) -> tuple[StateField, ...]:
        return (StateField("strain", (), (0.5 * dim,), "1", "the strain that the stress has relaxed to"),)

    @staticmethod
    def wave_modulus(theta: Array) -> Array:
        return np.asarray(3.0 * theta[0])


def stress(term: Any, theta: Any, F: Any, C: Any, h: Any, dt: float) -> Any:
    """Return (tau, h_next)."""
    e = 0.5 * inner(F, F)
    return scale(mul_bt(F, F), theta[0] * (e - h[0])), ((theta[1] * h[0] + e * dt) / (theta[1] + dt),)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, h: Any, dt: float, tau_bar: Any, h_next_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar, h_bar)."""
    e, pull = 0.5 * inner(F, F), h_next_bar[0] / (theta[1] + dt)
    along, h_next = inner(tau_bar, mul_bt(F, F)), (theta[1] * h[0] + e * dt) / (theta[1] + dt)
    F_bar = scale(mul(symmetric(tau_bar), F), 2.0 * theta[0] * (e - h[0]))
    F_bar = add(F_bar, scale(F, theta[0] * along + pull * dt))
    theta_bar = ((e - h[0]) * along, pull * (h[0] - h_next))
    return theta_bar, F_bar, zeros_like_rows(F), (pull * theta[1] - theta[0] * along,)


register_with_history(RelaxationKernel, stress, stress_vjp, rate=False)
