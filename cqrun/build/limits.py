"""The largest stable substep of each part of a model.

Elastic and viscous waves: with c^2 = (lam + 2 mu + incompressibility + active stress) / rho and
z = (4/3 eta + zeta) / (rho c dx), explicit integration is stable up to

    dt_max = (dx / c) (sqrt(1 + z^2) - z) = (dx / c) / (sqrt(1 + z^2) + z),

which is the Courant limit dx / c without viscosity, and the diffusive limit for z >> 1. Particles: |v| dt < dx / 2.
For particles that start from rest and are accelerated directly by a, this becomes a dt^2 / 2 < dx / 2.

Contact adds a spring and a dashpot to the nodes at a surface. An oscillator x'' = -w^2 x - r x', whose velocity is
stepped first, is stable up to w^2 dt^2 + 2 r dt = 4. Its w^2 is that of the fastest wave, (2 / dt_wave)^2, plus that of
the spring.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cqrun.plugin.contract import Array

SAFETY = 0.6
"""Part of the limit that `auto` uses, because waves are faster in compressed material."""

MOST_SUBSTEPS = 10_000_000
"""Largest number of substeps in a control step; more mean that some number of the scene has the wrong unit."""

WARN, REFUSE = 0.7, 1.15
"""Parts of the limit above which a given substep causes a warning, or is refused."""


@dataclass(frozen=True)
class Limit:
    """A bound on dt [s] and the part that causes it. One that is `estimated` refuses no given substeps."""

    part: str
    dt: float
    estimated: bool = False


def wave_limit(part: str, dx: float, density: Array, modulus: Array, viscosity: Array) -> Limit:
    """Return the bound of a material.

    Args:
        density: (n,) mass over rest volume [kg/m^D].
        modulus: (n,) lam + 2 mu, plus incompressibility and active stress [Pa].
        viscosity: (n,) 4/3 eta + zeta [Pa s].
    """
    with np.errstate(over="ignore", divide="ignore"):  # an infinite modulus allows no step at all
        c = np.sqrt(np.asarray(modulus) / density)
        z = np.asarray(viscosity) / (density * c * dx)
        return Limit(part, float(np.min(dx / c / (np.hypot(1.0, z) + z))))


def motion_limit(part: str, dx: float, v: Array) -> Limit | None:
    """Return the bound for particles that start with velocities v (N, D); None if they start at rest."""
    with np.errstate(over="ignore"):
        fastest = float(np.linalg.norm(v, axis=1).max(initial=0.0))
    return Limit(part, 0.5 * dx / fastest) if fastest > 0 else None


def push_limit(part: str, dx: float, acceleration: float) -> Limit | None:
    """Return the bound for an acceleration: in one substep from rest, particles must move less than half a cell."""
    return Limit(part, float(np.sqrt(dx / acceleration))) if acceleration > 0 else None


def contact_limit(part: str, wave: Limit, square: float, rate: float) -> Limit:
    """Return the bound of a body in contact.

    Args:
        wave: the bound of the body's waves.
        square: squared frequency of its nodes on the springs of contact [1/s^2].
        rate: at which dashpots damp it [1/s].
    """
    total = (2.0 / wave.dt) ** 2 + square
    return Limit(part, float(4.0 / (rate + np.sqrt(rate**2 + 4.0 * total))))


def auto_substeps(control_step: float, limits: list[Limit]) -> int:
    """Return how many substeps a control step needs."""
    return max(1, int(np.ceil(control_step / (SAFETY * min(limit.dt for limit in limits)) - 1e-9)))


def rounded_away(size: Array, dt: float) -> float:
    """Return the speed [m/s] below which float32 loses motion: less than a position's last bit in a substep.

    Args:
        size: edges of the world (D,) [m].
        dt: the substep [s].
    """
    return float(np.finfo(np.float32).eps) * float(np.max(size)) / dt
