"""Lame parameters from Young's modulus and Poisson's ratio, and the adjoint, on numbers or lanes."""

from __future__ import annotations

from typing import Any

from numba.extending import register_jitable

from cqrun.plugin.contract import Array


@register_jitable
def lame(E: Any, nu: Any) -> Any:
    """Return mu = E / (2 (1 + nu)) and lam = E nu / ((1 + nu) (1 - 2 nu)) [Pa]."""
    return E / (2.0 * (1.0 + nu)), E * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))


@register_jitable
def lame_vjp(E: Any, nu: Any, mu_bar: Any, lam_bar: Any) -> Any:
    """Return (E_bar, nu_bar)."""
    a, b = 1.0 + nu, 1.0 - 2.0 * nu
    E_bar = mu_bar / (2.0 * a) + lam_bar * nu / (a * b)
    nu_bar = lam_bar * E * (1.0 + 2.0 * nu * nu) / (a * a * b * b) - mu_bar * E / (2.0 * a * a)
    return E_bar, nu_bar


def p_wave_modulus(theta: Array) -> Array:
    """Return lam + 2 mu [Pa] for rows E, nu of theta (2, n)."""
    mu, lam = lame(theta[0], theta[1])
    return lam + 2.0 * mu


def shear_modulus(theta: Array) -> Array:
    """Return mu [Pa] for rows E, nu of theta (2, n)."""
    return lame(theta[0], theta[1])[0]
