"""Tendon: a cable that rubs in its guide, or several cables on one spool.

Each of its routes is taken for itself. With the tension T_0 at the first point of the route, the driven end, and the
angles t_i by which the route bends at its points, the tension of segment i is that of the capstan,

    T_i = T_0 exp(-mu (t_1 + ... + t_i)).

So a tendon is taken to be pulled in. With the activation u, the spool drives a route with the level
a = max(0, begin + turn u), and

    T_0 = a T  (a motor sets the force),    T_0 = k max(0, L - a R)  (a motor sets the length, and gives way there).

Each segment pulls its two ends together, so the tendon adds no net force and no net moment. Friction leaves it without
a potential, and the angles have a kink where the route is straight; there their derivative is taken as zero.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cqrun.forces.force import ACTIVATION, FRICTION, REST, STRENGTH, Levels, Shares, register_force
from cqrun.forces.route import difference, put_pair, segment
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array

MOST_ROUTES = 8
"""Routes on one spool; the constants of a tendon have room for them."""

BY_LENGTH, ROUTES, FIRST, EACH = 0, 1, 2, 3
"""Constants: whether a motor sets its length, the number of routes, and then `EACH` for each route: its segments,
`begin` and `turn`."""


class TendonKernel(NamedTuple):
    """All tendons of a scene that rub."""

    shares: Shares
    parts: Array
    constants: Array


class SpoolKernel(NamedTuple):
    """All spools of a scene with several routes that do not rub."""

    shares: Shares
    parts: Array
    constants: Array


class Line(NamedTuple):
    """A route of a tendon: its number of points, and its level is max(0, begin + turn u)."""

    points: int
    begin: float
    turn: float


def tendon_constants(by_length: bool, lines: list[Line]) -> Array:
    """Return the constants of a tendon for its kernel."""
    out = np.zeros(FIRST + EACH * MOST_ROUTES)
    out[BY_LENGTH], out[ROUTES] = by_length, len(lines)
    for k, line in enumerate(lines):
        out[FIRST + EACH * k : FIRST + EACH * (k + 1)] = line.points - 1, line.begin, line.turn
    return out


def lines_of(constants: Array) -> list[Line]:
    """Return the routes of a tendon from its constants."""
    rows = constants[FIRST:].reshape(-1, EACH)[: int(constants[ROUTES])]
    return [Line(int(count) + 1, float(begin), float(turn)) for count, begin, turn in rows]


def segments_of_all(columns: Array, constants: Array) -> list[Array]:
    """Return the single item of a part: the two points of each segment of every route."""
    routes = np.split(columns, np.cumsum([line.points for line in lines_of(constants)])[:-1])
    return [np.concatenate([np.repeat(route, 2)[1:-1] for route in routes])]


@kernel
def bend(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Return the angle between the unit vectors of two segments, its cosine, and the inverse of its sine; 0 for 1/0."""
    c = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    s = np.sqrt(x * x + y * y + z * z)
    return np.arctan2(s, c), c, 1.0 / s if s > 0.0 else 0.0


@kernel
def level_of(tendons: TendonKernel, item: int, route: int, u: float) -> float:
    """Return begin + turn u of a route."""
    at = FIRST + EACH * route
    return tendons.constants[item, at + 1] + tendons.constants[item, at + 2] * u


@kernel
def length_between(shares: Shares, first: int, last: int, q: Array) -> float:
    """Return the length of the segments whose shares are first .. last [m]."""
    total = 0.0
    for s in range(first, last, 2):
        total += segment(q, shares.columns[s], shares.columns[s + 1], shares.force.shape[1] == 3)[3]
    return total


@kernel
def driven(
    tendons: TendonKernel, item: int, route: int, first: int, last: int, levels: Levels, control: int, q: Array
) -> tuple[float, float]:
    """Return the tension at the driven end of a route, and what its strength is multiplied by, if not negative."""
    a = tendons.parts[item]
    level = level_of(tendons, item, route, levels.activation[control, a])
    if tendons.constants[item, BY_LENGTH] == 0.0:
        factor = level
    else:
        left = 0.0 if level <= 0.0 else level * levels.rest[a]
        factor = length_between(tendons.shares, first, last, q) - left
    return 0.0 if factor <= 0.0 else levels.strength[a] * factor, factor  # NaN must pull too: then it is reported


@kernel
def wind(tendons: TendonKernel, item: int, levels: Levels, control: int, q: Array) -> None:
    """Write the shares of one tendon."""
    shares, mu = tendons.shares, levels.friction[tendons.parts[item]]
    in_3d, first = shares.force.shape[1] == 3, shares.begin[item]
    for route in range(int(tendons.constants[item, ROUTES])):
        last = first + 2 * int(tendons.constants[item, FIRST + EACH * route])
        tension, _ = driven(tendons, item, route, first, last, levels, control, q)
        before = segment(q, shares.columns[first], shares.columns[first + 1], in_3d)
        for s in range(first, last, 2):
            now = segment(q, shares.columns[s], shares.columns[s + 1], in_3d)
            if s > first:
                tension *= np.exp(-mu * bend(before, now)[0])
            put_pair(shares.force, s, tension * now[0], tension * now[1], tension * now[2])
            before = now
        first = last


@kernel
def shared_work(
    shares: Shares, first: int, last: int, mu: float, q: Array, push_bar: Array
) -> tuple[float, float]:  # fmt: skip
    """Return sums over the segments of w e and of w e (t_1 + ... + t_i), with w = T_i / T_0 and e = t_i . push_bar."""
    in_3d, turned, total, by_angle = shares.force.shape[1] == 3, 0.0, 0.0, 0.0
    before = segment(q, shares.columns[first], shares.columns[first + 1], in_3d)
    for s in range(first, last, 2):
        p, r = shares.columns[s], shares.columns[s + 1]
        now = segment(q, p, r, in_3d)
        turned += bend(before, now)[0] if s > first else 0.0
        x, y, z = difference(push_bar, p, r, in_3d)
        part = np.exp(-mu * turned) * (x * now[0] + y * now[1] + z * now[2])
        total, by_angle, before = total + part, by_angle + part * turned, now
    return total, by_angle


@kernel
def add_pair(table: Array, s: int, scale: float, x: float, y: float, z: float) -> None:
    """Add `scale` times a vector to the first share of a segment, and its opposite to the other."""
    table[s, 0] += scale * x
    table[s, 1] += scale * y
    table[s + 1, 0] -= scale * x
    table[s + 1, 1] -= scale * y
    if table.shape[1] == 3:
        table[s, 2] += scale * z
        table[s + 1, 2] -= scale * z


@kernel
def wind_vjp(tendons: TendonKernel, item: int, levels: Levels, control: int, q: Array, push_bar: Array) -> None:
    """Carry the cotangent of the forces back through tensions, angles and directions."""
    shares, a = tendons.shares, tendons.parts[item]
    mu, strength, first = levels.friction[a], levels.strength[a], shares.begin[item]
    shares.level_bar[item, :] = 0.0
    for route in range(int(tendons.constants[item, ROUTES])):
        at = FIRST + EACH * route
        last = first + 2 * int(tendons.constants[item, at])
        tension, factor = driven(tendons, item, route, first, last, levels, control, q)
        level = level_of(tendons, item, route, levels.activation[control, a])
        # one-sided derivatives at the kinks: those of a taut cable, and of a level above zero
        T_bar, by_angle = shared_work(shares, first, last, mu, q, push_bar)
        length_bar = 0.0
        if factor < 0.0:
            T_bar = 0.0
        elif tendons.constants[item, BY_LENGTH] == 0.0:
            shares.level_bar[item, ACTIVATION] += tendons.constants[item, at + 2] * strength * T_bar
            shares.level_bar[item, STRENGTH] += factor * T_bar
        else:
            length_bar = strength * T_bar
            shares.level_bar[item, STRENGTH] += factor * T_bar
            if level >= 0.0:
                shares.level_bar[item, REST] -= level * length_bar
                shares.level_bar[item, ACTIVATION] -= tendons.constants[item, at + 2] * levels.rest[a] * length_bar
        shares.level_bar[item, FRICTION] -= tension * by_angle
        unwind(shares, first, last, mu, tension, T_bar, length_bar, q, push_bar)
        first = last


@kernel
def unwind(
    shares: Shares, first: int, last: int, mu: float, tension: float, ahead: float, length_bar: float, q: Array,
    push_bar: Array,
) -> None:  # fmt: skip
    """Write the cotangents of a route's points; `ahead` is the sum of w e over the segments that are still to come."""
    in_3d, full, turned = shares.force.shape[1] == 3, tension, 0.0
    before = segment(q, shares.columns[first], shares.columns[first + 1], in_3d)
    for s in range(first, last, 2):
        p, r = shares.columns[s], shares.columns[s + 1]
        now = segment(q, p, r, in_3d)
        angle, c, inverse = bend(before, now)
        turned += angle if s > first else 0.0
        share = np.exp(-mu * turned)
        x, y, z = difference(push_bar, p, r, in_3d)
        along = x * now[0] + y * now[1] + z * now[2]
        turn = full * share / now[3] if now[3] > 0.0 else 0.0
        put_pair(
            shares.x_bar, s, -(turn * (x - along * now[0]) + length_bar * now[0]),
            -(turn * (y - along * now[1]) + length_bar * now[1]), -(turn * (z - along * now[2]) + length_bar * now[2]),
        )  # fmt: skip
        if s > first and inverse > 0.0:
            # of the angle: minus its derivatives by the two vectors, which are (c now - before) / s, and the other way
            bar = mu * full * ahead * inverse
            one, other = bar / before[3], bar / now[3]
            add_pair(shares.x_bar, s - 2, one, c * before[0] - now[0], c * before[1] - now[1], c * before[2] - now[2])
            add_pair(shares.x_bar, s, other, c * now[0] - before[0], c * now[1] - before[1], c * now[2] - before[2])
        ahead -= share * along
        before = now


@kernel
def turning(
    before: tuple[float, float, float, float], now: tuple[float, float, float, float],
    turned: tuple[float, float, float], turns: tuple[float, float, float],
) -> tuple[float, float]:  # fmt: skip
    """Return the angle between two segments, and its change, for the changes of their unit vectors."""
    angle, _, inverse = bend(before, now)
    change = now[0] * turned[0] + now[1] * turned[1] + now[2] * turned[2]
    change += before[0] * turns[0] + before[1] * turns[1] + before[2] * turns[2]
    return angle, -inverse * change


@kernel
def turn_of(
    now: tuple[float, float, float, float], x: float, y: float, z: float
) -> tuple[float, float, float]:  # fmt: skip
    """Return the change of the unit vector of a segment whose last point moves by (x, y, z) from its first."""
    along = x * now[0] + y * now[1] + z * now[2]
    inverse = 1.0 / now[3] if now[3] > 0.0 else 0.0
    return inverse * (x - along * now[0]), inverse * (y - along * now[1]), inverse * (z - along * now[2])


@kernel
def wind_jvp(tendons: TendonKernel, item: int, levels: Levels, control: int, q: Array, move: Array) -> None:
    """Write the change of the shares of one tendon with a displacement of its points, to their x_bar."""
    shares, mu = tendons.shares, levels.friction[tendons.parts[item]]
    in_3d, first = shares.force.shape[1] == 3, shares.begin[item]
    for route in range(int(tendons.constants[item, ROUTES])):
        last = first + 2 * int(tendons.constants[item, FIRST + EACH * route])
        tension, factor = driven(tendons, item, route, first, last, levels, control, q)
        change = 0.0
        if tendons.constants[item, BY_LENGTH] != 0.0 and factor >= 0.0:
            longer = 0.0
            for s in range(first, last, 2):
                p, r = shares.columns[s], shares.columns[s + 1]
                t, (x, y, z) = segment(q, p, r, in_3d), difference(move, r, p, in_3d)
                longer += x * t[0] + y * t[1] + z * t[2]
            change = levels.strength[tendons.parts[item]] * longer
        before = segment(q, shares.columns[first], shares.columns[first + 1], in_3d)
        turned = (0.0, 0.0, 0.0)
        for s in range(first, last, 2):
            p, r = shares.columns[s], shares.columns[s + 1]
            now, (x, y, z) = segment(q, p, r, in_3d), difference(move, r, p, in_3d)
            turns = turn_of(now, x, y, z)
            if s > first:
                angle, more = turning(before, now, turned, turns)
                left = np.exp(-mu * angle)
                tension, change = left * tension, left * (change - mu * more * tension)
            put_pair(
                shares.x_bar, s, tension * turns[0] + change * now[0], tension * turns[1] + change * now[1],
                tension * turns[2] + change * now[2],
            )  # fmt: skip
            before, turned = now, turns
        first = last


register_force(TendonKernel, segments_of_all, wind, wind_vjp, rate=False, exert_jvp=wind_jvp)
register_force(SpoolKernel, segments_of_all, wind, wind_vjp, rate=False)
