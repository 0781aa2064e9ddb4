"""Mooney and Rivlin's law: W = c10 (I1b - 3) + c01 (I2b - 3)  (Rivlin, Phil. Trans. R. Soc. A 241, 1948).

With s = J^(-2/3), B = F F^T, I1 = tr B and I2 = (I1^2 - tr B^2) / 2, all in 3D (rubber.py):

    tau_W = 2 c10 s (B - I1/3 I) + 2 c01 s^2 (I1 B - B^2 - 2/3 I2 I).
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Self

from numba.extending import register_jitable
from pydantic import model_validator

from cqrun.explain import complaint, finding
from cqrun.materials.rubber import Rubber, Shape, out_of_plane, register_rubber
from cqrun.numerics.roots import inverse_cube_root
from cqrun.numerics.tensor import add, cofactor, det, inner, mul, mul_at, mul_bt, plus_diagonal, scale, sub, trace
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class MooneyRivlinKernel(NamedTuple):
    """Kernels' view: rows c10, c01 [Pa], and K [Pa] or nu."""

    theta: Array
    rows: tuple[int, int, int]
    by_ratio: int


@plugin("elastic", "mooney_rivlin")
class MooneyRivlin(Rubber):
    """Mooney and Rivlin's law, W = c10 (I1b - 3) + c01 (I2b - 3), and U(J) = K/4 (J^2 - 1 - 2 log J).

    It fits tension up to a stretch of about 2, and has no upturn. With c01 from a uniaxial test alone it is often far
    too stiff in equibiaxial tension. The shear modulus at rest is 2 (c10 + c01). c01 = 0 is a Neo-Hookean law.
    """

    kernel: ClassVar[Any] = MooneyRivlinKernel
    own: ClassVar[tuple[str, ...]] = ("c10", "c01")
    c10: float = quantity("Pa", "Coefficient of I1b - 3", differentiable=True)
    c01: float = quantity("Pa", "Coefficient of I2b - 3", differentiable=True, default=0.0)

    @model_validator(mode="after")
    def _has_a_shear_modulus(self) -> Self:
        if not self.c10 + self.c01 > 0:
            message = f"half the shear modulus at rest, c10 + c01, must be above 0, is {self.c10 + self.c01:g}"
            raise complaint("MooneyRivlin", [finding(message, ("c01",), involves=("c10",))])
        return self


@register_jitable
def invariants(F: Any) -> Any:
    """Return B, J, s = J^(-2/3), I1, and I2."""
    B, J, zz = mul_bt(F, F), det(F), out_of_plane(F)
    r, I1 = inverse_cube_root(J), trace(B) + zz
    return B, J, r * r, I1, 0.5 * (I1 * I1 - inner(B, B) - zz)


def stress(term: Any, theta: Any, F: Any) -> Any:
    """Return tau_W."""
    B, _, s, I1, I2 = invariants(F)
    return parts(theta[0], theta[1], B, s, I1, I2)


@register_jitable
def parts(c10: Any, c01: Any, B: Any, s: Any, I1: Any, I2: Any) -> Any:
    """Return tau_W of the invariants."""
    a, q = 2.0 * c10 * s, 2.0 * c01 * s * s
    tau = sub(scale(B, a + q * I1), scale(mul(B, B), q))
    return plus_diagonal(tau, (a * I1 + 2.0 * q * I2) * (-1.0 / 3.0))


def both(term: Any, theta: Any, F: Any, tau_bar: Any) -> Any:
    """Return (tau_W, theta_bar, F_bar)."""
    B, J, s, I1, I2 = invariants(F)
    a, q, tr = 2.0 * theta[0] * s, 2.0 * theta[1] * s * s, trace(tau_bar)
    along, squared = inner(tau_bar, B), inner(tau_bar, mul(B, B))
    a_bar = along - tr * I1 * (1.0 / 3.0)
    q_bar = I1 * along - squared - tr * I2 * (2.0 / 3.0)
    s_bar = 2.0 * theta[0] * a_bar + 4.0 * theta[1] * s * q_bar
    # through B: a B + q (I1 B - B^2), and the traces I1, I2 with dI2 = I1 dI1 - B : dB
    B_bar = sub(scale(tau_bar, a + q * I1), scale(add(mul(tau_bar, B), mul(B, tau_bar)), q))
    B_bar = add(B_bar, scale(B, q * tr * (2.0 / 3.0)))
    B_bar = plus_diagonal(B_bar, q * along - tr * (a + 2.0 * q * I1) * (1.0 / 3.0))
    F_bar = add(mul(B_bar, F), mul_at(B_bar, F))
    F_bar = add(F_bar, scale(cofactor(F), s_bar * s / J * (-2.0 / 3.0)))
    return parts(theta[0], theta[1], B, s, I1, I2), (2.0 * s * a_bar, 2.0 * s * s * q_bar), F_bar


def energy(term: Any, theta: Any, F: Any) -> Any:
    """Return W."""
    _, _, s, I1, I2 = invariants(F)
    return theta[0] * (s * I1 - 3.0) + theta[1] * (s * s * I2 - 3.0)


def energy_vjp(term: Any, theta: Any, F: Any, W_bar: Any) -> Any:
    """Return (theta_bar, F_bar)."""
    B, J, s, I1, I2 = invariants(F)
    by_B, by_s = theta[0] * s + theta[1] * s * s * I1, theta[0] * I1 + 2.0 * theta[1] * s * I2
    F_bar = sub(scale(F, 2.0 * by_B), scale(mul(B, F), 2.0 * theta[1] * s * s))
    F_bar = add(F_bar, scale(cofactor(F), by_s * s / J * (-2.0 / 3.0)))
    return ((s * I1 - 3.0) * W_bar, (s * s * I2 - 3.0) * W_bar), scale(F_bar, W_bar)


def shear(theta: Any) -> Any:
    """Return mu at rest."""
    return 2.0 * (theta[0] + theta[1])


def shear_vjp(theta: Any, mu_bar: Any) -> Any:
    """Return theta_bar."""
    return (2.0 * mu_bar, 2.0 * mu_bar)


register_rubber(MooneyRivlinKernel, Shape(stress, both, energy, energy_vjp, shear, shear_vjp))
