"""Laws of rubber: an energy of the change of shape alone, and one of the change of volume alone.

    psi = W + U(J),   U = K/4 (J^2 - 1 - 2 log J),   J = det F

W depends on J^(-1/3) F, which keeps its volume, so its stress tau_W has no mean in 3D. U adds K/2 (J^2 - 1) I, which
resists J -> 0 without bound. (Holzapfel, Nonlinear Solid Mechanics, 2000, sections 6.4 and 6.5.)

Most laws know only the first invariant, W(x) with x = I1b - 3:

    I1b = J^(-2/3) tr B,   B = F F^T,   tau_W = g J^(-2/3) (B - tr(B)/3 I),   g = 2 dW/dx.

In 2D a body is in plane strain: F_zz = 1, which adds 1 to the trace of B. A law's file gives g and W
(`first_invariant`), or its stress and energy as such; `register_rubber` adds U.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, Self

from numba.extending import register_jitable
from pydantic import model_validator

from cqrun.explain import complaint, finding
from cqrun.materials.term import (
    MaterialTerm,
    add_rows,
    register,
    register_energy,
    register_volume,
    with_row,
    zeros_like_rows,
)
from cqrun.numerics.lanes import log
from cqrun.numerics.roots import inverse_cube_root
from cqrun.numerics.tensor import add, cofactor, det, inner, mul, mul_at, mul_bt, plus_diagonal, scale, trace
from cqrun.plugin.contract import Array, quantity


class Rubber(MaterialTerm):
    """Base of the laws of rubber: its bulk modulus is given as such, or by Poisson's ratio.

    A kernel class has the fields theta, rows and by_ratio. The rows of theta are the parameters of W, then K or nu.

    Attributes:
        kernel: the kernel class.
        own: names of the parameters of W.
    """

    kernel: ClassVar[Any]
    own: ClassVar[tuple[str, ...]] = ()
    bulk_modulus: float | None = quantity("Pa", "Bulk modulus K", differentiable=True, gt=0, default=None)
    poissons_ratio: float | None = quantity(
        "1", "Poisson's ratio nu at rest, in place of K = 2 mu (1 + nu) / (3 (1 - 2 nu))", differentiable=True, gt=-1,
        lt=0.5, default=None,
    )  # fmt: skip

    @model_validator(mode="after")
    def _one_of_two(self) -> Self:
        if (self.bulk_modulus is None) == (self.poissons_ratio is None):
            message = "needs one of `poissons_ratio` (silicones: 0.49 to 0.4999) and `bulk_modulus`"
            raise complaint(type(self).__name__, [finding(message, ())])
        return self

    @property
    def parameters(self) -> tuple[str, ...]:
        """The fields that are rows of theta."""
        return (*self.own, "bulk_modulus" if self.poissons_ratio is None else "poissons_ratio")

    def kernel_term(self, theta: Array) -> Any:
        """Return the kernels' view."""
        return self.kernel(theta, (0,) * len(self.parameters), int(self.poissons_ratio is not None))

    def shear_modulus(self, theta: Array) -> Array:  # type: ignore[override]
        """Return mu at rest [Pa], shape (n,)."""
        return initial_shear(self.kernel, theta)

    def wave_modulus(self, theta: Array) -> Array:  # type: ignore[override]
        """Return K + 4/3 mu [Pa], shape (n,)."""
        mu = self.shear_modulus(theta)
        return bulk(self.kernel_term(theta), theta, mu) + 4.0 / 3.0 * mu


_SHEAR: dict[type, Callable[[Any], Any]] = {}


def initial_shear(kernel_class: type, theta: Any) -> Any:
    """Return mu at rest [Pa] for the rows of theta."""
    return _SHEAR[kernel_class](theta)


# --- the bulk modulus -------------------------------------------------------------------------------------------------


@register_jitable
def bulk(term: Any, theta: Any, mu: Any) -> Any:
    """Return K [Pa] for mu at rest: the last row of theta is K, or nu."""
    last = theta[-1]
    return 2.0 / 3.0 * mu * (1.0 + last) / (1.0 - 2.0 * last) if term.by_ratio else last


@register_jitable
def bulk_vjp(term: Any, theta: Any, mu: Any, K_bar: Any) -> Any:
    """Return the cotangents of mu and of the last row."""
    last, zero = theta[-1], 0.0 * K_bar
    below = 1.0 / (1.0 - 2.0 * last)
    by_mu, by_last = 2.0 / 3.0 * (1.0 + last) * below * K_bar, 2.0 * mu * below * below * K_bar
    return (by_mu, by_last) if term.by_ratio else (zero, K_bar)


# --- W and U together -------------------------------------------------------------------------------------------------


class Shape(NamedTuple):
    """What a law says of W; cotangents are of the parameters of W alone.

    Attributes:
        stress: (term, theta, F) -> tau_W.
        both: (term, theta, F, tau_bar) -> tau_W, theta_bar, F_bar.
        energy: (term, theta, F) -> W.
        energy_vjp: (term, theta, F, W_bar) -> theta_bar, F_bar.
        shear: theta -> mu at rest.
        shear_vjp: theta, mu_bar -> theta_bar.
    """

    stress: Callable[..., Any]
    both: Callable[..., Any]
    energy: Callable[..., Any]
    energy_vjp: Callable[..., Any]
    shear: Callable[..., Any]
    shear_vjp: Callable[..., Any]


def register_rubber(kernel_class: type, shape: Shape) -> None:
    """Register the functions of a law of rubber: those of W, and U."""
    _SHEAR[kernel_class] = shape.shear
    w_stress, w_both, w_energy, w_energy_vjp, shear, shear_vjp = (register_jitable(f) for f in shape)

    def stress(term: Any, theta: Any, F: Any, C: Any) -> Any:
        J, K = det(F), bulk(term, theta, shear(theta))
        return plus_diagonal(w_stress(term, theta, F), 0.5 * K * (J * J - 1.0))

    @register_jitable
    def rows(term: Any, theta: Any, own_bar: Any, K_bar: Any) -> Any:
        """Return the cotangent of all rows of theta."""
        mu_bar, last_bar = bulk_vjp(term, theta, shear(theta), K_bar)
        return with_row(add_rows(own_bar, shear_vjp(theta, mu_bar)), last_bar)

    @register_jitable
    def both(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
        J, K, tr = det(F), bulk(term, theta, shear(theta)), trace(tau_bar)
        tau, own_bar, F_bar = w_both(term, theta, F, tau_bar)
        tau = plus_diagonal(tau, 0.5 * K * (J * J - 1.0))
        F_bar = add(F_bar, scale(cofactor(F), K * J * tr))
        return tau, rows(term, theta, own_bar, 0.5 * (J * J - 1.0) * tr), F_bar, zeros_like_rows(F)

    def stress_vjp(term: Any, theta: Any, F: Any, C: Any, tau_bar: Any) -> Any:
        found = both(term, theta, F, C, tau_bar)
        return found[1], found[2], found[3]

    def slope(term: Any, theta: Any, J: Any) -> Any:
        return 0.5 * bulk(term, theta, shear(theta)) * (J - 1.0 / J)

    def slope_vjp(term: Any, theta: Any, J: Any, slope_bar: Any) -> Any:
        zero = zeros_like_rows(shear_vjp(theta, slope_bar))
        theta_bar = rows(term, theta, zero, 0.5 * (J - 1.0 / J) * slope_bar)
        return theta_bar, 0.5 * bulk(term, theta, shear(theta)) * (1.0 + 1.0 / (J * J)) * slope_bar

    def energy(term: Any, theta: Any, F: Any) -> Any:
        J, K = det(F), bulk(term, theta, shear(theta))
        return w_energy(term, theta, F) + 0.25 * K * (J * J - 1.0 - 2.0 * log(J))

    def energy_vjp(term: Any, theta: Any, F: Any, psi_bar: Any) -> Any:
        J, K = det(F), bulk(term, theta, shear(theta))
        own_bar, F_bar = w_energy_vjp(term, theta, F, psi_bar)
        F_bar = add(F_bar, scale(cofactor(F), 0.5 * K * (J - 1.0 / J) * psi_bar))
        return rows(term, theta, own_bar, 0.25 * (J * J - 1.0 - 2.0 * log(J)) * psi_bar), F_bar

    register(kernel_class, stress, stress_vjp, rate=False, both=both)
    register_volume(kernel_class, slope, slope_vjp)
    register_energy(kernel_class, energy, energy_vjp)


# --- laws of the first invariant --------------------------------------------------------------------------------------


@register_jitable
def out_of_plane(F: Any) -> Any:
    """Return B_zz of a body in plane strain, which is not among the entries of F: 1 in 2D, 0 in 3D."""
    return 1.0 if len(F) == 4 else 0.0


def first_invariant(
    response: Callable[..., Any], response_vjp: Callable[..., Any], potential: Callable[..., Any],
    potential_vjp: Callable[..., Any], shear: Callable[..., Any], shear_vjp: Callable[..., Any],
) -> Shape:  # fmt: skip
    """Return what a law says of W that depends on x = I1b - 3 alone.

    Args:
        response: (theta, x) -> g = 2 dW/dx.
        response_vjp: (theta, x, g_bar) -> theta_bar, x_bar.
        potential: (theta, x) -> W.
        potential_vjp: (theta, x, W_bar) -> theta_bar.
        shear, shear_vjp: as in `Shape`.
    """
    g_of, g_vjp, W_of, W_vjp = (register_jitable(f) for f in (response, response_vjp, potential, potential_vjp))

    def stress(term: Any, theta: Any, F: Any) -> Any:
        B, r = mul_bt(F, F), inverse_cube_root(det(F))
        s, I1 = r * r, trace(B) + out_of_plane(F)
        a = g_of(theta, s * I1 - 3.0) * s
        return plus_diagonal(scale(B, a), a * I1 * (-1.0 / 3.0))

    def both(term: Any, theta: Any, F: Any, tau_bar: Any) -> Any:
        # tau = a (B - I1/3 I), a = g s, s = J^(-2/3)
        B, J, tr = mul_bt(F, F), det(F), trace(tau_bar)
        r = inverse_cube_root(J)
        s, I1 = r * r, trace(B) + out_of_plane(F)
        x = s * I1 - 3.0
        g = g_of(theta, x)
        a = g * s
        a_bar = inner(tau_bar, B) - tr * I1 * (1.0 / 3.0)
        theta_bar, x_bar = g_vjp(theta, x, a_bar * s)
        s_bar, I1_bar = a_bar * g + x_bar * I1, x_bar * s - tr * a * (1.0 / 3.0)
        F_bar = scale(add(mul(tau_bar, F), mul_at(tau_bar, F)), a)
        F_bar = add(F_bar, scale(F, 2.0 * I1_bar))
        F_bar = add(F_bar, scale(cofactor(F), s_bar * s / J * (-2.0 / 3.0)))
        return plus_diagonal(scale(B, a), a * I1 * (-1.0 / 3.0)), theta_bar, F_bar

    def energy(term: Any, theta: Any, F: Any) -> Any:
        r = inverse_cube_root(det(F))
        return W_of(theta, r * r * (inner(F, F) + out_of_plane(F)) - 3.0)

    def energy_vjp(term: Any, theta: Any, F: Any, W_bar: Any) -> Any:
        J, I1 = det(F), inner(F, F) + out_of_plane(F)
        r = inverse_cube_root(J)
        s = r * r
        x_bar = 0.5 * g_of(theta, s * I1 - 3.0) * W_bar
        F_bar = add(scale(F, 2.0 * s * x_bar), scale(cofactor(F), s * I1 / J * x_bar * (-2.0 / 3.0)))
        return W_vjp(theta, s * I1 - 3.0, W_bar), F_bar

    return Shape(stress, both, energy, energy_vjp, shear, shear_vjp)
