"""The stress of a fluid's pressure in the pores of a material, tau = -p J I.

It follows from the energy -p J, so it does the work of a pressure on the deformed volume.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.materials.term import register, zeros_like_rows
from cqrun.numerics.tensor import cofactor, det, plus_diagonal, scale, trace
from cqrun.plugin.contract import Array


class PressureKernel(NamedTuple):
    """Kernels' view: one row, the pressure [Pa], filled from the activations."""

    theta: Array
    rows: tuple[int, ...]


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    return plus_diagonal(zeros_like_rows(F), -(theta[0] * det(F)))


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    pull = -trace(tau_bar)
    return (pull * det(F),), scale(cofactor(F), pull * theta[0]), zeros_like_rows(F)


register(PressureKernel, stress, stress_vjp, rate=False)
