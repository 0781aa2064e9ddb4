"""Neo-Hookean elasticity: P = mu (F - F^-T) + lam log(J) F^-T  (CQ2 eq 13).

tau = P F^T = mu (F F^T - I) + lam log(J) I, from the energy mu/2 (tr F F^T - D - 2 log J) + lam/2 log(J)^2.
It has a pole at J = 0: an inverted element gives a stress that is not finite, which stops the rollout.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from cqrun.materials.lame import lame, lame_vjp, p_wave_modulus, shear_modulus
from cqrun.materials.term import MaterialTerm, register, register_energy, register_volume, zeros_like_rows
from cqrun.numerics.lanes import log
from cqrun.numerics.tensor import add, cofactor, det, inner, mul, mul_at, mul_bt, plus_diagonal, scale, trace
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class NeoHookeanKernel(NamedTuple):
    """Kernels' view: rows E [Pa], nu."""

    theta: Array
    rows: tuple[int, int]


@plugin("elastic", "neo_hookean")
class NeoHookean(MaterialTerm):
    """Neo-Hookean elasticity, P = mu (F - F^-T) + lam log(J) F^-T (CQ2 eq 13).

    It is the material of every experiment in CQ2. It stiffens without bound as the volume goes to zero.
    In 2D it is in plane strain: E and nu are those of the 3D material, and a thin beam bends like one of modulus
    E / (1 - nu^2).
    """

    parameters: ClassVar[tuple[str, ...]] = ("youngs_modulus", "poissons_ratio")
    youngs_modulus: float = quantity("Pa", "Young's modulus E", differentiable=True, gt=0)
    poissons_ratio: float = quantity("1", "Poisson's ratio nu", differentiable=True, gt=-1, lt=0.5)

    def kernel_term(self, theta: Array) -> NeoHookeanKernel:
        return NeoHookeanKernel(theta, (0, 0))

    wave_modulus = staticmethod(p_wave_modulus)
    shear_modulus = staticmethod(shear_modulus)


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    mu, lam = lame(theta[0], theta[1])
    return plus_diagonal(scale(mul_bt(F, F), mu), lam * log(det(F)) - mu)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    mu, lam = lame(theta[0], theta[1])
    J, tr = det(F), trace(tau_bar)
    mu_bar = inner(tau_bar, mul_bt(F, F)) - tr
    lam_bar = log(J) * tr
    F_bar = scale(add(mul(tau_bar, F), mul_at(tau_bar, F)), mu)
    F_bar = add(F_bar, scale(cofactor(F), lam * tr / J))
    return lame_vjp(theta[0], theta[1], mu_bar, lam_bar), F_bar, zeros_like_rows(F)


register(NeoHookeanKernel, stress, stress_vjp, rate=False)


def slope(term: Any, theta: Any, J: Any) -> Any:
    """Return U' of U = lam/2 log(J)^2."""
    return lame(theta[0], theta[1])[1] * log(J) / J


def slope_vjp(term: Any, theta: Any, J: Any, slope_bar: Any) -> Any:
    """Return (theta_bar, J_bar)."""
    theta_bar = lame_vjp(theta[0], theta[1], slope_bar * 0.0, slope_bar * log(J) / J)
    return theta_bar, lame(theta[0], theta[1])[1] * (1.0 - log(J)) / (J * J) * slope_bar


register_volume(NeoHookeanKernel, slope, slope_vjp)


def energy(term: Any, theta: Any, F: Any) -> Any:
    """Return psi = mu/2 (tr F^T F - D - 2 log J) + lam/2 log(J)^2."""
    mu, lam = lame(theta[0], theta[1])
    by_mu, by_lam = _parts(F)
    return mu * by_mu + lam * by_lam


def energy_vjp(term: Any, theta: Any, F: Any, psi_bar: Any) -> Any:
    """Return (theta_bar, F_bar), F_bar = psi_bar P."""
    mu, lam = lame(theta[0], theta[1])
    by_mu, by_lam = _parts(F)
    J = det(F)
    P = add(scale(F, mu), scale(cofactor(F), (lam * log(J) - mu) / J))
    return lame_vjp(theta[0], theta[1], by_mu * psi_bar, by_lam * psi_bar), scale(P, psi_bar)


def _parts(F: Any) -> Any:
    """Return what mu and lam are multiplied by."""
    J, dim = det(F), 2 if len(F) == 4 else 3
    return 0.5 * (inner(F, F) - dim) - log(J), 0.5 * log(J) * log(J)


register_energy(NeoHookeanKernel, energy, energy_vjp)
