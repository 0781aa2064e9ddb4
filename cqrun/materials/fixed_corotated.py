"""Fixed corotated elasticity: P = 2 mu (F - R) + lam (J - 1) J F^-T  (CQ2 eq 12; Stomakhin et al. 2012).

tau = P F^T = 2 mu (F - R) F^T + lam (J - 1) J I, from the energy mu |F - R|^2 + lam/2 (J - 1)^2.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from numba.extending import register_jitable

from cqrun.materials.lame import lame, lame_vjp, p_wave_modulus, shear_modulus
from cqrun.materials.term import MaterialTerm, register, register_energy, register_volume, zeros_like_rows
from cqrun.numerics.polar import polar, polar_vjp
from cqrun.numerics.tensor import (
    add,
    cofactor,
    det,
    inner,
    mul,
    mul_at,
    mul_bt,
    plus_diagonal,
    scale,
    sub,
    trace,
)
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class FixedCorotatedKernel(NamedTuple):
    """Kernels' view: rows E [Pa], nu."""

    theta: Array
    rows: tuple[int, int]


@plugin("elastic", "fixed_corotated")
class FixedCorotated(MaterialTerm):
    """Fixed corotated elasticity, P = 2 mu (F - R) + lam (J - 1) J F^-T (CQ2 eq 12).

    It is robust under large rotations and inversion, and the default in the software of both ChainQueen papers.
    In 2D it is in plane strain: E and nu are those of the 3D material, and a thin beam bends like one of modulus
    E / (1 - nu^2).
    """

    parameters: ClassVar[tuple[str, ...]] = ("youngs_modulus", "poissons_ratio")
    youngs_modulus: float = quantity("Pa", "Young's modulus E", differentiable=True, gt=0)
    poissons_ratio: float = quantity("1", "Poisson's ratio nu", differentiable=True, gt=-1, lt=0.5)

    def kernel_term(self, theta: Array) -> FixedCorotatedKernel:
        return FixedCorotatedKernel(theta, (0, 0))

    wave_modulus = staticmethod(p_wave_modulus)
    shear_modulus = staticmethod(shear_modulus)


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    mu, lam = lame(theta[0], theta[1])
    J = det(F)
    return plus_diagonal(scale(mul_bt(sub(F, polar(F)), F), 2.0 * mu), lam * (J - 1.0) * J)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    return both(term, theta, F, C, tau_bar)[1:]


@register_jitable
def both(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (tau, theta_bar, F_bar, C_bar); stress and adjoint share the rotation, which costs most."""
    mu, lam = lame(theta[0], theta[1])
    J, R = det(F), polar(F)
    stretch, tr = sub(F, R), trace(tau_bar)
    tau = plus_diagonal(scale(mul_bt(stretch, F), 2.0 * mu), lam * (J - 1.0) * J)
    mu_bar = 2.0 * inner(tau_bar, mul_bt(stretch, F))
    lam_bar = tr * (J - 1.0) * J
    # tau = 2 mu (F F^T - R F^T) + ...: through both F, through R, and through J
    direct = add(mul(tau_bar, F), mul_at(tau_bar, stretch))
    through_R = polar_vjp(F, R, scale(mul(tau_bar, F), -1.0))
    F_bar = scale(add(direct, through_R), 2.0 * mu)
    F_bar = add(F_bar, scale(cofactor(F), lam * (2.0 * J - 1.0) * tr))
    return tau, lame_vjp(theta[0], theta[1], mu_bar, lam_bar), F_bar, zeros_like_rows(F)


register(FixedCorotatedKernel, stress, stress_vjp, rate=False, both=both)


def slope(term: Any, theta: Any, J: Any) -> Any:
    """Return U' of U = lam/2 (J - 1)^2."""
    return lame(theta[0], theta[1])[1] * (J - 1.0)


def slope_vjp(term: Any, theta: Any, J: Any, slope_bar: Any) -> Any:
    """Return (theta_bar, J_bar)."""
    theta_bar = lame_vjp(theta[0], theta[1], slope_bar * 0.0, slope_bar * (J - 1.0))
    return theta_bar, lame(theta[0], theta[1])[1] * slope_bar


register_volume(FixedCorotatedKernel, slope, slope_vjp)


def energy(term: Any, theta: Any, F: Any) -> Any:
    """Return psi = mu |F - R|^2 + lam/2 (J - 1)^2."""
    mu, lam = lame(theta[0], theta[1])
    stretch, J = sub(F, polar(F)), det(F)
    return mu * inner(stretch, stretch) + 0.5 * lam * (J - 1.0) * (J - 1.0)


def energy_vjp(term: Any, theta: Any, F: Any, psi_bar: Any) -> Any:
    """Return (theta_bar, F_bar), F_bar = psi_bar P; R does not add to P, because F - R is normal to all rotations."""
    mu, lam = lame(theta[0], theta[1])
    stretch, J = sub(F, polar(F)), det(F)
    P = add(scale(stretch, 2.0 * mu), scale(cofactor(F), lam * (J - 1.0)))
    by_mu, by_lam = inner(stretch, stretch), 0.5 * (J - 1.0) * (J - 1.0)
    return lame_vjp(theta[0], theta[1], by_mu * psi_bar, by_lam * psi_bar), scale(P, psi_bar)


register_energy(FixedCorotatedKernel, energy, energy_vjp)
