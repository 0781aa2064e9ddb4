"""Routes: straight lines through particles, along which cables and springs pull.

The length of a route along particles x_1 .. x_r is L = sum_i |x_{i+1} - x_i|; t_i is the unit vector from x_i to
x_{i+1}. A tension T pulls x_i with T (t_i - t_{i-1}), which adds no net force and no net torque.

The shares of a route (`force.py`) are those of its segments, one after the other; the two shares of a segment pull its
first and its last particle.
"""

from __future__ import annotations

import itertools
from typing import Annotated, Protocol

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.explain import Loc
from cqrun.forces.force import Inside, Shares
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array
from cqrun.state import X

Point = Annotated[list[float], Field(min_length=2, max_length=3)]


class Pulling(Protocol):
    """What pulls along a route: the law of its tension, outside kernels."""

    def pull(self, length: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the tension [N] at each moment (T,), for the length and the activation then (T,)."""

    def stored(self, length: Array, activation: Array, strength: float, rest: float) -> Array:
        """Return the energy [J] whose derivative by the length is the tension (T,)."""

    def stored_vjp(
        self, length: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of length, activation, strength and rest length at each moment, all (T,)."""

    def pull_vjp(
        self, length: Array, activation: Array, strength: float, rest: float, bar: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return the cotangents of length, activation, strength and rest length at each moment, all (T,)."""


# --- in a scene --------------------------------------------------------------------------------------------


def route_problems(route: list[Point], dim: int) -> list[tuple[Loc, str]]:
    """Return the errors in the points of a route in a world of `dim` dimensions."""
    problems: list[tuple[Loc, str]] = [
        (("route", k), f"must have {dim} entries in this {dim}D world, has {len(point)}")
        for k, point in enumerate(route)
        if len(point) != dim
    ]
    return problems + [
        (("route", k + 1), "is the same as the point before it: remove one of the two")
        for k, (point, next_point) in enumerate(itertools.pairwise(route))
        if point == next_point
    ]


MOST_PIECES = 10_000
"""Largest number of pieces of a line: a search among all particles for each of more would take minutes."""


def particles_along(route: list[Point], spacing: float | None, body: str, x: Array, inside: Inside) -> Array:
    """Return the particles along a route, in order: the nearest to its points, and to places every `spacing`.

    Raises:
        UsageError: the spacing is far too small.
    """
    of_body = inside(body, None)

    def nearest(place: Array) -> int:
        return int(of_body[np.argmin(((x[of_body] - place) ** 2).sum(axis=1))])

    points = np.array(route)
    tied = [nearest(point) for point in points]
    along = tied[:1]
    for k, (begin, end) in enumerate(itertools.pairwise(points)):
        length = float(np.linalg.norm(end - begin))
        wanted = 1.0 if spacing is None else length / spacing
        if wanted > MOST_PIECES:
            raise UsageError(
                f"a spacing of {spacing:g} m ties a line of {length:.3g} m at {wanted:.3g} points, more than "
                f"{MOST_PIECES:,}: give one near the distance of its body's particles"
            )
        pieces = max(1, round(wanted))
        for piece in range(1, pieces):
            particle = nearest(begin + (end - begin) * piece / pieces)
            # if the spacing is less than the distance of particles, the same particle is nearest again
            if particle not in (along[-1], tied[k + 1]):
                along.append(particle)
        along.append(tied[k + 1])
    return np.array(along, np.int64)


def route_problem(route: list[Point], body: str, x: Array, dx: float) -> str | None:
    """Return the error in a route along particles at x (r, D) [m] with cells of dx [m], or None."""
    for point in route:
        gap = np.linalg.norm(x - np.array(point), axis=1)
        if gap.min() > dx:
            near, place = (", ".join(f"{c:.4g}" for c in of) for of in (x[np.argmin(gap)], point))
            return (
                f"its point ({place}) is {gap.min():.3g} m from the body '{body}', whose nearest particle at "
                f"rest is at ({near}): each point of a route must lie within a cell ({dx:.3g} m) of a particle"
            )
    different = len(np.unique(x, axis=0))
    if different < 2:
        return "runs through fewer than two particles: lengthen the route"
    if different < len(x):
        return "runs through a particle twice: separate the points of the route, or tie it less often (`spacing`)"
    return None


def route_length(x: Array) -> float:
    """Return the length [m] of a route along particles at x (r, D) [m]."""
    return float(np.linalg.norm(np.diff(x, axis=0), axis=1).sum())


def route_length_vjp(x: Array, bar: float) -> Array:
    """Return the cotangent of x (r, D)."""
    gaps = np.diff(x, axis=0)
    along = bar * gaps / np.linalg.norm(gaps, axis=1, keepdims=True)
    ends = np.zeros((1, x.shape[1]))
    return np.asarray(np.concatenate([ends, along]) - np.concatenate([along, ends]))


# --- in kernels --------------------------------------------------------------------------------------------


def segments_of(columns: Array, constants: Array) -> list[Array]:
    """Return the single item of a part: the first and the last particle of each segment."""
    return [np.repeat(columns, 2)[1:-1]]


@kernel
def segment(q: Array, p: int, r: int, in_3d: bool) -> tuple[float, float, float, float]:
    """Return the unit vector from particle p to particle r, and their distance [m]."""
    w = q.shape[2]
    x = q[r // w, X, r % w] - q[p // w, X, p % w]
    y = q[r // w, X + 1, r % w] - q[p // w, X + 1, p % w]
    z = q[r // w, X + 2, r % w] - q[p // w, X + 2, p % w] if in_3d else 0.0 * x
    length = np.sqrt(x * x + y * y + z * z)
    inverse = 1.0 / length if length > 0.0 else 0.0 * length
    return x * inverse, y * inverse, z * inverse, length


@kernel
def length_along(shares: Shares, item: int, q: Array) -> float:
    """Return the length of an item's route [m]."""
    total = 0.0
    for s in range(shares.begin[item], shares.begin[item + 1], 2):
        total += segment(q, shares.columns[s], shares.columns[s + 1], shares.force.shape[1] == 3)[3]
    return total


@kernel
def put_pair(table: Array, s: int, x: float, y: float, z: float) -> None:
    """Write a vector to the first share of a segment, and its opposite to the other."""
    table[s, 0], table[s, 1] = x, y
    table[s + 1, 0], table[s + 1, 1] = -x, -y
    if table.shape[1] == 3:
        table[s, 2], table[s + 1, 2] = z, -z


@kernel
def pull_along(shares: Shares, item: int, tension: float, q: Array) -> None:
    """Write the shares of a tension [N] along an item's route."""
    for s in range(shares.begin[item], shares.begin[item + 1], 2):
        x, y, z, _ = segment(q, shares.columns[s], shares.columns[s + 1], shares.force.shape[1] == 3)
        put_pair(shares.force, s, tension * x, tension * y, tension * z)


@kernel
def clear_item(table: Array, shares: Shares, item: int) -> None:
    """Set an item's rows of a table of shares to zero."""
    for s in range(shares.begin[item], shares.begin[item + 1]):
        table[s, :] = 0.0


@kernel
def difference(force_bar: Array, p: int, r: int, in_3d: bool) -> tuple[float, float, float]:
    """Return the cotangent of the force on p minus that of the force on r."""
    w = force_bar.shape[2]
    x = force_bar[p // w, 0, p % w] - force_bar[r // w, 0, r % w]
    y = force_bar[p // w, 1, p % w] - force_bar[r // w, 1, r % w]
    z = force_bar[p // w, 2, p % w] - force_bar[r // w, 2, r % w] if in_3d else 0.0 * x
    return x, y, z


@kernel
def tension_bar(shares: Shares, item: int, q: Array, push_bar: Array) -> float:
    """Return the cotangent of the tension along an item's route."""
    total, in_3d = 0.0, shares.force.shape[1] == 3
    for s in range(shares.begin[item], shares.begin[item + 1], 2):
        p, r = shares.columns[s], shares.columns[s + 1]
        x, y, z, _ = segment(q, p, r, in_3d)
        fx, fy, fz = difference(push_bar, p, r, in_3d)
        total += fx * x + fy * y + fz * z
    return total


@kernel
def pull_along_vjp(shares: Shares, item: int, tension: float, length_bar: float, q: Array, push_bar: Array) -> None:
    """Write the cotangents of the particles' positions, through the length and the segments' directions."""
    in_3d = shares.force.shape[1] == 3
    for s in range(shares.begin[item], shares.begin[item + 1], 2):
        p, r = shares.columns[s], shares.columns[s + 1]
        x, y, z, length = segment(q, p, r, in_3d)
        fx, fy, fz = difference(push_bar, p, r, in_3d)
        along = fx * x + fy * y + fz * z
        turn = tension / length if length > 0.0 else 0.0 * length
        dx = turn * (fx - along * x) + length_bar * x
        dy = turn * (fy - along * y) + length_bar * y
        dz = turn * (fz - along * z) + length_bar * z
        put_pair(shares.x_bar, s, -dx, -dy, -dz)
