"""Yeoh's law: W = c10 x + c20 x^2 + c30 x^3, x = I1b - 3  (Yeoh, Rubber Chem. Technol. 66, 1993)."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from cqrun.materials.rubber import Rubber, first_invariant, register_rubber
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class YeohKernel(NamedTuple):
    """Kernels' view: rows c10, c20, c30 [Pa], and K [Pa] or nu."""

    theta: Array
    rows: tuple[int, int, int, int]
    by_ratio: int


@plugin("elastic", "yeoh")
class Yeoh(Rubber):
    """Yeoh's law, W = c10 x + c20 x^2 + c30 x^3 with x = I1b - 3, and U(J) = K/4 (J^2 - 1 - 2 log J).

    It follows the S of a silicone's curve in all modes from a uniaxial test alone: it knows only the first invariant.
    The shear modulus at rest is 2 c10. With c20 < 0 it may have a largest force; `cqrun validate` says where.
    """

    kernel: ClassVar[Any] = YeohKernel
    own: ClassVar[tuple[str, ...]] = ("c10", "c20", "c30")
    c10: float = quantity("Pa", "Coefficient of I1b - 3, half the shear modulus at rest", differentiable=True, gt=0)
    c20: float = quantity("Pa", "Coefficient of (I1b - 3)^2", differentiable=True, default=0.0)
    c30: float = quantity("Pa", "Coefficient of (I1b - 3)^3", differentiable=True, default=0.0)


def response(theta: Any, x: Any) -> Any:
    """Return g = 2 dW/dx."""
    return 2.0 * theta[0] + x * (4.0 * theta[1] + 6.0 * theta[2] * x)


def response_vjp(theta: Any, x: Any, g_bar: Any) -> Any:
    """Return (theta_bar, x_bar)."""
    theta_bar = (2.0 * g_bar, 4.0 * x * g_bar, 6.0 * x * x * g_bar)
    return theta_bar, (4.0 * theta[1] + 12.0 * theta[2] * x) * g_bar


def potential(theta: Any, x: Any) -> Any:
    """Return W."""
    return x * (theta[0] + x * (theta[1] + x * theta[2]))


def potential_vjp(theta: Any, x: Any, W_bar: Any) -> Any:
    """Return theta_bar."""
    return (x * W_bar, x * x * W_bar, x * x * x * W_bar)


def shear(theta: Any) -> Any:
    """Return mu at rest."""
    return 2.0 * theta[0]


def shear_vjp(theta: Any, mu_bar: Any) -> Any:
    """Return theta_bar."""
    return (2.0 * mu_bar, 0.0 * mu_bar, 0.0 * mu_bar)


register_rubber(YeohKernel, first_invariant(response, response_vjp, potential, potential_vjp, shear, shear_vjp))
