"""An elastic law of your own. Here it is St. Venant-Kirchhoff: tau = F S F^T, S = lam tr(E) I + 2 mu E.

E = (F^T F - I) / 2 is the Green strain. Change `stress` to your law, and `stress_vjp` to its adjoint: for
gradients the two must agree, which `cqrun gradcheck my_elastic.yaml --allow-plugins` checks.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from cqrun.materials.lame import lame, lame_vjp, p_wave_modulus
from cqrun.materials.term import MaterialTerm, register, zeros_like_rows
from cqrun.numerics.tensor import add, inner, mul, mul_at, mul_bt, plus_diagonal, scale, symmetric, trace
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class MyElasticKernel(NamedTuple):
    """What kernels see: rows E [Pa], nu. This class selects the functions that kernels call."""

    theta: Array
    rows: tuple[int, int]


@plugin("elastic", "my_elastic")
class MyElastic(MaterialTerm):
    """St. Venant-Kirchhoff elasticity, S = lam tr(E) I + 2 mu E, E = (F^T F - I) / 2.

    Linear in the Green strain E: right for large rotations, soft under strong compression. This text is the page of the
    law: `cqrun describe elastic my_elastic --plugin my_elastic.py`.
    """

    parameters: ClassVar[tuple[str, ...]] = ("youngs_modulus", "poissons_ratio")
    youngs_modulus: float = quantity("Pa", "Young's modulus E", differentiable=True, gt=0)
    poissons_ratio: float = quantity("1", "Poisson's ratio nu", differentiable=True, gt=-1, lt=0.5)

    def kernel_term(self, theta: Array) -> MyElasticKernel:
        return MyElasticKernel(theta, (0, 0))

    @staticmethod
    def wave_modulus(theta: Array) -> Array:
        return p_wave_modulus(theta)  # the time step's bound: lam + 2 mu


def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
    """Return tau."""
    mu, lam = lame(theta[0], theta[1])
    strain = plus_diagonal(scale(mul_at(F, F), 0.5), -0.5)
    S = plus_diagonal(scale(strain, 2.0 * mu), lam * trace(strain))
    return mul_bt(mul(F, S), F)


def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
    """Return (theta_bar, F_bar, C_bar)."""
    mu, lam = lame(theta[0], theta[1])
    strain = plus_diagonal(scale(mul_at(F, F), 0.5), -0.5)
    S = plus_diagonal(scale(strain, 2.0 * mu), lam * trace(strain))
    # tau = F S F^T, with S held
    F_bar = scale(mul(mul(symmetric(tau_bar), F), S), 2.0)
    # S depends on the strain, and the strain depends on F
    S_bar = mul(mul_at(F, symmetric(tau_bar)), F)
    strain_bar = plus_diagonal(scale(S_bar, 2.0 * mu), lam * trace(S_bar))
    F_bar = add(F_bar, mul(F, strain_bar))
    mu_bar, lam_bar = 2.0 * inner(strain, S_bar), trace(strain) * trace(S_bar)
    return lame_vjp(theta[0], theta[1], mu_bar, lam_bar), F_bar, zeros_like_rows(F)


register(MyElasticKernel, stress, stress_vjp)
