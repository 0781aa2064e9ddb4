"""The eight-chain law, in the five terms of its series that finite-element programs use.

    W = mu sum_i C_i / lock^(2 i - 2) (I1b^i - 3^i),   C = 1/2, 1/20, 11/1050, 19/7000, 519/673750

(Arruda and Boyce, J. Mech. Phys. Solids 41, 1993; the series is that of Abaqus's *ARRUDA-BOYCE.)
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from numba.extending import register_jitable

from cqrun.materials.rubber import Rubber, first_invariant, register_rubber
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin

C1, C2, C3, C4, C5 = 1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750


class ArrudaBoyceKernel(NamedTuple):
    """Kernels' view: rows mu [Pa], lock, and K [Pa] or nu."""

    theta: Array
    rows: tuple[int, int, int]
    by_ratio: int


@plugin("elastic", "arruda_boyce")
class ArrudaBoyce(Rubber):
    """The eight-chain law of Arruda and Boyce, five terms of its series, and U(J) = K/4 (J^2 - 1 - 2 log J).

    `lock` is the stretch of a chain at which it is straight. The shear modulus at rest is a little larger than mu: by
    3 / (5 lock^2), and terms of higher order. The series is finite at any stretch, also beyond the limit.
    """

    kernel: ClassVar[Any] = ArrudaBoyceKernel
    own: ClassVar[tuple[str, ...]] = ("mu", "lock")
    mu: float = quantity("Pa", "Modulus of the chains", differentiable=True, gt=0)
    lock: float = quantity("1", "Stretch at which a chain is straight", differentiable=True, gt=1)


@register_jitable
def series(q: Any, I: Any) -> Any:
    """Return 2 dW/dI1b / mu, for q = 1 / lock^2."""
    y = q * I
    return 2.0 * (C1 + y * (2.0 * C2 + y * (3.0 * C3 + y * (4.0 * C4 + y * (5.0 * C5)))))


@register_jitable
def series_slope(q: Any, I: Any) -> Any:
    """Return the derivative of `series` by y = q I1b."""
    y = q * I
    return 2.0 * (2.0 * C2 + y * (6.0 * C3 + y * (12.0 * C4 + y * (20.0 * C5))))


def response(theta: Any, x: Any) -> Any:
    """Return g = 2 dW/dx."""
    return theta[0] * series(1.0 / (theta[1] * theta[1]), x + 3.0)


def response_vjp(theta: Any, x: Any, g_bar: Any) -> Any:
    """Return (theta_bar, x_bar)."""
    q, I = 1.0 / (theta[1] * theta[1]), x + 3.0
    y_bar = theta[0] * series_slope(q, I) * g_bar
    return (series(q, I) * g_bar, -2.0 * y_bar * I * q / theta[1]), y_bar * q


@register_jitable
def sums(q: Any, I: Any) -> Any:
    """Return W / mu plus a number that depends on q."""
    y = q * I
    return I * (C1 + y * (C2 + y * (C3 + y * (C4 + y * C5))))


@register_jitable
def sums_slope(q: Any, I: Any) -> Any:
    """Return the derivative of `sums` by q."""
    y = q * I
    return I * I * (C2 + y * (2.0 * C3 + y * (3.0 * C4 + y * (4.0 * C5))))


def potential(theta: Any, x: Any) -> Any:
    """Return W."""
    q = 1.0 / (theta[1] * theta[1])
    return theta[0] * (sums(q, x + 3.0) - sums(q, 3.0 + 0.0 * x))


def potential_vjp(theta: Any, x: Any, W_bar: Any) -> Any:
    """Return theta_bar."""
    q, rest = 1.0 / (theta[1] * theta[1]), 3.0 + 0.0 * x
    by_q = theta[0] * (sums_slope(q, x + 3.0) - sums_slope(q, rest)) * W_bar
    return ((sums(q, x + 3.0) - sums(q, rest)) * W_bar, -2.0 * by_q * q / theta[1])


def shear(theta: Any) -> Any:
    """Return mu at rest."""
    return theta[0] * series(1.0 / (theta[1] * theta[1]), 3.0)


def shear_vjp(theta: Any, mu_bar: Any) -> Any:
    """Return theta_bar."""
    q = 1.0 / (theta[1] * theta[1])
    return (series(q, 3.0) * mu_bar, -6.0 * theta[0] * series_slope(q, 3.0) * q / theta[1] * mu_bar)


register_rubber(ArrudaBoyceKernel, first_invariant(response, response_vjp, potential, potential_vjp, shear, shear_vjp))
