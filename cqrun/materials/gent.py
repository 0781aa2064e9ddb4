"""Gent's law: W = -mu jm/2 log(1 - x/jm), x = I1b - 3  (Gent, Rubber Chem. Technol. 69, 1996)."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np

from cqrun.materials.rubber import Rubber, first_invariant, register_rubber
from cqrun.materials.term import register_limit
from cqrun.numerics.lanes import below, log, select
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


class GentKernel(NamedTuple):
    """Kernels' view: rows mu [Pa], jm, and K [Pa] or nu."""

    theta: Array
    rows: tuple[int, int, int]
    by_ratio: int


@plugin("elastic", "gent")
class Gent(Rubber):
    """Gent's law, W = -mu jm/2 log(1 - x/jm) with x = I1b - 3, and U(J) = K/4 (J^2 - 1 - 2 log J).

    Chains of finite length: the stress grows without bound as I1b - 3 nears jm. A state beyond it has no stress, and
    stops the run with the particle's name. jm = 30 is a stretch of 5.7 in uniaxial tension.
    """

    kernel: ClassVar[Any] = GentKernel
    own: ClassVar[tuple[str, ...]] = ("mu", "jm")
    mu: float = quantity("Pa", "Shear modulus at rest", differentiable=True, gt=0)
    jm: float = quantity("1", "Limit of I1b - 3", differentiable=True, gt=0)


def response(theta: Any, x: Any) -> Any:
    """Return g = mu jm / (jm - x); NaN from the limit on, where the formula gives a stress of the wrong sign."""
    return select(below(x, theta[1]), theta[0] * theta[1] / (theta[1] - x), x * 0.0 + np.nan)


def response_vjp(theta: Any, x: Any, g_bar: Any) -> Any:
    """Return (theta_bar, x_bar)."""
    left = 1.0 / (theta[1] - x)
    by_x = theta[0] * theta[1] * left * left * g_bar
    return (theta[1] * left * g_bar, -theta[0] * x * left * left * g_bar), by_x


def potential(theta: Any, x: Any) -> Any:
    """Return W."""
    return -0.5 * theta[0] * theta[1] * log(1.0 - x / theta[1])


def potential_vjp(theta: Any, x: Any, W_bar: Any) -> Any:
    """Return theta_bar."""
    stretched = log(1.0 - x / theta[1])
    return (
        -0.5 * theta[1] * stretched * W_bar,
        -0.5 * theta[0] * (stretched + x / (theta[1] - x)) * W_bar,
    )


def shear(theta: Any) -> Any:
    """Return mu at rest."""
    return theta[0]


def shear_vjp(theta: Any, mu_bar: Any) -> Any:
    """Return theta_bar."""
    return (mu_bar, 0.0 * mu_bar)


register_rubber(GentKernel, first_invariant(response, response_vjp, potential, potential_vjp, shear, shear_vjp))
register_limit(
    GentKernel,
    "its law `gent` has no stress from I1b - 3 = jm on: if it is stretched so far, give a larger jm, or load it less",
)
