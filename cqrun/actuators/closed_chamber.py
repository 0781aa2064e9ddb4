"""A closed chamber: the pressure of the gas or liquid that is in it, which depends on its volume.

With the volume V, the volume at rest V0, the activation u and the amount s that it adds,

    p = (c + u s k) V0 / V - c,    E = -integral p dV = c (V - V0) - (c + u s k) V0 ln(V / V0).

Gas, isothermal: c is the pressure around the body, k = 1, and u s is the pressure that the added gas has in V0. Liquid:
c = k is its bulk modulus, and u s is the share of V0 that is added. The tangent is symmetric, p dN/dx + dp/dV N N^T.
"""

from __future__ import annotations

from typing import NamedTuple

from cqrun.forces.force import ACTIVATION, REST, STRENGTH, Levels, Shares, register_force
from cqrun.forces.wall import facet_work, press_facet, press_facet_vjp, volume_of
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array


class ClosedKernel(NamedTuple):
    """All closed chambers of a scene; each is one item, because all its facets feel one volume."""

    shares: Shares
    parts: Array
    constants: Array  # (I, 2) c and k


def wall_in_one(columns: Array, constants: Array) -> list[Array]:
    """Return the points of all facets of a part, in one item; the constants are D, c, k and then the facets."""
    return [columns[constants[3:].astype(int)]]


@kernel
def amount(chambers: ClosedKernel, item: int, levels: Levels, control: int) -> float:
    """Return c + u s k [Pa]: the pressure, above none, of what is in the chamber, at its rest volume."""
    a = chambers.parts[item]
    return float(
        chambers.constants[item, 0] + levels.activation[control, a] * levels.strength[a] * chambers.constants[item, 1]
    )


@kernel
def swell_closed(chambers: ClosedKernel, item: int, levels: Levels, control: int, q: Array) -> None:
    """Write the shares of one chamber."""
    shares, rest = chambers.shares, levels.rest[chambers.parts[item]]
    held = amount(chambers, item, levels, control)
    pressure = held * rest / volume_of(shares, item, q) - chambers.constants[item, 0]
    for s in range(shares.begin[item], shares.begin[item + 1], shares.force.shape[1]):
        press_facet(shares, s, pressure, q)


@kernel
def swell_closed_vjp(
    chambers: ClosedKernel, item: int, levels: Levels, control: int, q: Array, push_bar: Array
) -> None:
    """Carry the cotangent of the forces back, through the normals and through the volume."""
    shares, a, k = chambers.shares, chambers.parts[item], chambers.constants[item, 1]
    begin, end, step = shares.begin[item], shares.begin[item + 1], shares.force.shape[1]
    rest, volume, held = levels.rest[a], volume_of(shares, item, q), amount(chambers, item, levels, control)
    pressure, work = held * rest / volume - chambers.constants[item, 0], 0.0
    for s in range(begin, end, step):
        work += facet_work(shares, s, q, push_bar)[0]
    volume_bar = -work * held * rest / (volume * volume)
    shares.level_bar[item, ACTIVATION] = work * levels.strength[a] * k * rest / volume
    shares.level_bar[item, STRENGTH] = work * levels.activation[control, a] * k * rest / volume
    shares.level_bar[item, REST] = work * held / volume
    for s in range(begin, end, step):
        press_facet_vjp(shares, s, pressure, volume_bar, q, facet_work(shares, s, q, push_bar)[1])


register_force(ClosedKernel, wall_in_one, swell_closed, swell_closed_vjp, rate=False, own=slice(1, 3))
