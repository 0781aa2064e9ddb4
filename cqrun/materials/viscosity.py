"""Kelvin-Voigt viscosity: tau_v = J (2 eta dev(d) + zeta tr(d) I), d = sym(C).

C is the affine velocity matrix, the particle's velocity gradient. dev(d) = d - tr(d)/3 I also in 2D (plane strain:
d_zz = 0). In a rigid rotation d = 0; the dissipation tau_v : d / J is never negative.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from cqrun.materials.term import MaterialTerm, register, register_energy, zeros_like_rows
from cqrun.numerics.tensor import cofactor, det, inner, plus_diagonal, scale, symmetric, trace
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class ViscosityKernel(NamedTuple):
    """Kernels' view: rows eta, zeta [Pa s]."""

    theta: Array
    rows: tuple[int, int]


@plugin("material_term", "viscosity")
class Viscosity(MaterialTerm):
    """Kelvin-Voigt viscosity, tau = J (2 eta dev(d) + zeta tr(d) I) with d the symmetric velocity gradient.

    dev(d) = d - tr(d)/3 I in 2D too: a 2D body is in plane strain, so d has a third row of zeros.
    """

    parameters: ClassVar[tuple[str, ...]] = ("shear", "bulk")
    shear: float = quantity("Pa s", "shear viscosity eta", differentiable=True, ge=0, default=0.0)
    bulk: float = quantity("Pa s", "bulk viscosity zeta", differentiable=True, ge=0, default=0.0)

    def kernel_term(self, theta: Array) -> ViscosityKernel:
        return ViscosityKernel(theta, (0, 0))

    @staticmethod
    def wave_viscosity(theta: Array) -> Array:
        return np.asarray(4.0 / 3.0 * theta[0] + theta[1])


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    J, tr = det(F), trace(C)
    return plus_diagonal(scale(symmetric(C), 2.0 * J * theta[0]), J * (theta[1] - theta[0] * (2.0 / 3.0)) * tr)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    J, tr, tr_bar = det(F), trace(C), trace(tau_bar)
    pull = symmetric(tau_bar)
    shear = 2.0 * inner(pull, symmetric(C)) - (2.0 / 3.0) * tr_bar * tr
    bulk = tr_bar * tr
    F_bar = scale(cofactor(F), theta[0] * shear + theta[1] * bulk)
    C_bar = plus_diagonal(scale(pull, 2.0 * J * theta[0]), J * (theta[1] - theta[0] * (2.0 / 3.0)) * tr_bar)
    return (J * shear, J * bulk), F_bar, C_bar


register(ViscosityKernel, stress, stress_vjp)


def energy(term: Any, theta: Any, F: Any) -> Any:
    """Return 0: it stores no energy."""
    return det(F) * 0.0


def energy_vjp(term: Any, theta: Any, F: Any, psi_bar: Any) -> Any:
    """Return (theta_bar, F_bar)."""
    return (psi_bar * 0.0, psi_bar * 0.0), zeros_like_rows(F)


register_energy(ViscosityKernel, energy, energy_vjp)
