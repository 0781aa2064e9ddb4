"""Incompressibility penalty: P += E / (3 (2 - 4 nu)) p (J - 1)^(p - 1) J F^-T  (CQ2 eq 14).

So tau += kappa/2 p (J - 1)^(p - 1) J I with the bulk modulus kappa = E / (3 (1 - 2 nu)), from the energy
kappa/2 (J - 1)^p. CQ2 prints 2 - 2 nu, which does not give a bulk modulus. With 2 - 4 nu the power p = 2 gives
kappa/2 (J - 1)^2 as in Bonet and Wood, whom CQ2 cites. p must be even: with an odd p the term would push in the same
direction for J < 1 and J > 1.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import Field, field_validator

from cqrun.materials.term import MaterialTerm, register, register_energy, register_volume, zeros_like_rows
from cqrun.numerics.tensor import cofactor, det, plus_diagonal, scale, trace
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


class IncompressibilityKernel(NamedTuple):
    """Kernels' view: rows E [Pa], nu, shared with the elastic term, and the even power."""

    theta: Array
    rows: tuple[int, int]
    power: int


@plugin("material_term", "incompressibility")
class Incompressibility(MaterialTerm):
    """Penalty on volume change: energy kappa/2 (J - 1)^power with the elastic term's bulk modulus kappa (CQ2 eq 14)."""

    parameters: ClassVar[tuple[str, ...]] = ("youngs_modulus", "poissons_ratio")
    power: int = Field(2, ge=2, description="even power p of J - 1 [1]")

    @field_validator("power")
    @classmethod
    def _even(cls, power: int) -> int:
        if power % 2:
            raise ValueError(
                f"{power} is odd: the penalty would push in the same direction for J < 1 and J > 1; use an even power"
            )
        return power

    def kernel_term(self, theta: Array) -> IncompressibilityKernel:
        return IncompressibilityKernel(theta, (0, 0), self.power)

    def wave_modulus(self, theta: Array) -> Array:  # type: ignore[override]
        """Return kappa for p = 2, otherwise 0: a higher power has no stiffness at J = 1."""
        return bulk_modulus(theta[0], theta[1]) * (self.power == 2)


def bulk_modulus(E: Any, nu: Any) -> Any:
    """Return kappa = E / (3 (1 - 2 nu)) [Pa]."""
    return np.asarray(E / (3.0 * (1.0 - 2.0 * nu)))


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    J = det(F)
    pressure = theta[0] / (6.0 - 12.0 * theta[1]) * J * term.power
    for _ in range(term.power - 1):
        pressure = pressure * (J - 1.0)
    return plus_diagonal(zeros_like_rows(F), pressure)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    J, tr, p = det(F), trace(tau_bar), term.power
    weight = 1.0 / (6.0 - 12.0 * theta[1])
    lower = J * 0.0 + p
    for _ in range(p - 2):
        lower = lower * (J - 1.0)
    per_modulus = lower * (J - 1.0) * J * weight
    E_bar = per_modulus * tr
    nu_bar = theta[0] * per_modulus * weight * 12.0 * tr
    # d/dJ of (J - 1)^(p-1) J
    slope = lower * ((J - 1.0) + J * (p - 1.0))
    return (E_bar, nu_bar), scale(cofactor(F), theta[0] * weight * slope * tr), zeros_like_rows(F)


register(IncompressibilityKernel, stress, stress_vjp, rate=False)


def slope(term: Any, theta: Any, J: Any) -> Any:
    """Return U' of U = kappa/2 (J - 1)^p."""
    slope = theta[0] / (6.0 - 12.0 * theta[1]) * term.power
    for _ in range(term.power - 1):
        slope = slope * (J - 1.0)
    return slope


def slope_vjp(term: Any, theta: Any, J: Any, slope_bar: Any) -> Any:
    """Return (theta_bar, J_bar)."""
    weight = 1.0 / (6.0 - 12.0 * theta[1])
    lower = slope_bar * (weight * term.power)
    for _ in range(term.power - 2):
        lower = lower * (J - 1.0)
    E_bar = lower * (J - 1.0)
    return (E_bar, theta[0] * E_bar * weight * 12.0), theta[0] * lower * (term.power - 1)


register_volume(IncompressibilityKernel, slope, slope_vjp)


def energy(term: Any, theta: Any, F: Any) -> Any:
    """Return psi = kappa/2 (J - 1)^p."""
    return theta[0] / (6.0 - 12.0 * theta[1]) * (det(F) - 1.0) ** term.power


def energy_vjp(term: Any, theta: Any, F: Any, psi_bar: Any) -> Any:
    """Return (theta_bar, F_bar)."""
    weight, J = 1.0 / (6.0 - 12.0 * theta[1]), det(F)
    E_bar = weight * (J - 1.0) ** term.power * psi_bar
    slope_bar = theta[0] * weight * term.power * (J - 1.0) ** (term.power - 1) * psi_bar
    return (E_bar, theta[0] * E_bar * weight * 12.0), scale(cofactor(F), slope_bar)


register_energy(IncompressibilityKernel, energy, energy_vjp)
