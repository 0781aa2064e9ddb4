"""The elastica: a thin inextensible cantilever under a dead load at its end, at any deflection.

With the angle t(s) of the centre line from its rest direction, s from the clamp, and the force (F_x, F_z) at the end,

    EI t'' = F_x sin t - F_z cos t,   t(0) = 0,   t'(L) = 0,   x' = cos t,   z' = sin t       (Love 1927, section 262).

In plane strain EI is that of a plate, E h^3 / (12 (1 - nu^2)) per width.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class Bent:
    """The end of a bent cantilever, over its length: displacement along and across, and the angle [rad]."""

    along: float
    across: float
    angle: float


def plate_stiffness(youngs_modulus: float, poissons_ratio: float, height: float) -> float:
    """Return EI [N m] per width of a beam in plane strain."""
    return youngs_modulus * height**3 / (12.0 * (1.0 - poissons_ratio**2))


def euler_load(stiffness: float, length: float) -> float:
    """Return the compression [N] at which a clamped column with a free end buckles: pi^2 EI / (4 L^2)."""
    return float(np.pi**2 * stiffness / (4.0 * length**2))


def elastica(load: float) -> Bent:
    """Return the end under a force across the beam's rest direction.

    Args:
        load: F L^2 / EI, >= 0; `across` has its sign.
    """
    if load == 0.0:
        return Bent(0.0, 0.0, 0.0)
    # the moment at the clamp is that of the force at an arm of at most L
    curvature = float(brentq(lambda k: _from_clamp(k, 0.0, load)[1], 1e-12, load, xtol=1e-14))
    return _end(curvature, 0.0, load)


def column(ratio: float) -> Bent:
    """Return the end of a column under a force against its rest direction, above the load at which it buckles.

    With k = sin(angle / 2): K(k) = (pi / 2) sqrt(ratio), across = 2 k / K, along = 2 E / K - 2 (Timoshenko and Gere
    1961, section 2.7).

    Args:
        ratio: load over the Euler load of the clamped column with a free end, > 1 and < 8.

    Raises:
        ValueError: the ratio is outside its range. Below 1 the column stays straight.
    """
    if not 1.0 < ratio < 8.0:
        raise ValueError(f"ratio must be above 1 and below 8, is {ratio}")
    m = float(brentq(lambda m: ellipk(m) - 0.5 * np.pi * np.sqrt(ratio), 0.0, 1.0 - 1e-12, xtol=1e-15))
    K = float(ellipk(m))
    return Bent(2.0 * float(ellipe(m)) / K - 2.0, 2.0 * np.sqrt(m) / K, 2.0 * float(np.arcsin(np.sqrt(m))))


def column_from_ode(ratio: float) -> Bent:
    """Return the same as `column` from the differential equation: an independent way for tests."""
    load = -0.25 * np.pi**2 * ratio
    bound = np.sqrt(4.0 * abs(load))  # the curvature at the clamp is 2 k sqrt(load)
    curvature = float(brentq(lambda k: _from_clamp(k, load, 0.0)[1], 0.05, bound * (1 - 1e-9), xtol=1e-14))
    return _end(curvature, load, 0.0)


def _end(curvature: float, load_x: float, load_z: float) -> Bent:
    angle, _, x, z = _from_clamp(curvature, load_x, load_z)
    return Bent(float(x - 1.0), float(z), float(angle))


def _from_clamp(curvature: float, load_x: float, load_z: float) -> Array:
    """Return angle, curvature, x and z at the end of a beam of length 1, integrated from the clamp."""

    def slope(_: float, state: Array) -> list[float]:
        angle, bend = state[:2]
        turn = load_x * np.sin(angle) - load_z * np.cos(angle)
        return [bend, turn, np.cos(angle), np.sin(angle)]

    start = [0.0, curvature, 0.0, 0.0]
    return np.asarray(solve_ivp(slope, (0.0, 1.0), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1])
