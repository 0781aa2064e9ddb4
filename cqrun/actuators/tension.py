"""Tension: a cable that a motor or a weight pulls with a known force, whatever its length.

With the length L of the route (`forces/route.py`), the tension T and the activation u, the energy is E = max(0, u) T L.
So the tension is max(0, u) T along the whole route: f_i = max(0, u) T (t_i - t_{i-1}). Friction is not part of it.
"""

from __future__ import annotations

from typing import NamedTuple

from cqrun.forces.force import ACTIVATION, STRENGTH, Levels, Shares, register_force
from cqrun.forces.route import clear_item, pull_along, pull_along_vjp, segments_of, tension_bar
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array


class TensionKernel(NamedTuple):
    """All cables of a scene whose tension is given."""

    shares: Shares
    parts: Array
    constants: Array


@kernel
def haul(cables: TensionKernel, item: int, levels: Levels, control: int, q: Array) -> None:
    """Write the shares of one cable."""
    a, shares = cables.parts[item], cables.shares
    u = levels.activation[control, a]
    # NaN must pull too: then the rollout reports the particles that it moves
    if not u <= 0.0:
        pull_along(shares, item, u * levels.strength[a], q)
    else:
        clear_item(shares.force, shares, item)


@kernel
def haul_vjp(cables: TensionKernel, item: int, levels: Levels, control: int, q: Array, push_bar: Array) -> None:
    """Carry the cotangent of the forces back through the tension and the segments' directions."""
    a, shares = cables.parts[item], cables.shares
    u, strength = levels.activation[control, a], levels.strength[a]
    shares.level_bar[item, :] = 0.0
    # at u = 0, a kink, the derivative is that of u > 0 (the legal side)
    if u >= 0.0:
        T_bar = tension_bar(shares, item, q, push_bar)
        shares.level_bar[item, ACTIVATION] = strength * T_bar
        shares.level_bar[item, STRENGTH] = u * T_bar
        pull_along_vjp(shares, item, u * strength, 0.0, q, push_bar)
    else:
        clear_item(shares.x_bar, shares, item)


register_force(TensionKernel, segments_of, haul, haul_vjp, rate=False)
