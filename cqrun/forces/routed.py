"""What pulls along routes: where its points are at rest.

In the reference frame a cable or a spring acts at the exact points of its routes, each of which rides on the nearest
particle of the body. In the updated frame it is tied to these particles. A point may also be fixed in the world.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cqrun.errors import UsageError
from cqrun.forces.force import Inside, Riding
from cqrun.forces.route import (
    MOST_PIECES,
    particles_along,
    route_length,
    route_length_vjp,
    route_problem,
)
from cqrun.plugin.contract import Array

WORLD = -1
"""The particle of a point that is fixed in the world."""


class Way(NamedTuple):
    """A route as a scene gives it.

    Attributes:
        points: (r, D) [m], which lie in the body.
        spacing: largest distance of the points that are put between them on straight lines; None for none [m].
        before, after: points of the world before the first and after the last one (D,) [m], or None.
    """

    points: Array
    spacing: float | None
    before: Array | None = None
    after: Array | None = None

    @property
    def leaves(self) -> bool:
        """Whether it has a point in the world."""
        return self.before is not None or self.after is not None


class Host(NamedTuple):
    """The body that a route runs through, at rest.

    Attributes:
        body: its name.
        x: all particles of the scene (N, D) [m].
        inside: finds the particles of a body and region.
        contains: which of some points (n, D) lie in the body, or on its surface (n,).
        dx: size of a cell [m].
        exact: whether forces act on points that ride on particles, as in the reference frame, or on particles.
    """

    body: str
    x: Array
    inside: Inside
    contains: Callable[[Array], Array]
    dx: float
    exact: bool


class Routed:
    """A plug-in that pulls along routes through a body, which its fields `body` and `route` name.

    A subclass with other routes than that of `route` has its own `ways`.
    """

    def ways(self) -> list[Way]:
        """Return its routes."""
        spec: Any = self
        return [Way(np.array(spec.route), getattr(spec, "spacing", None))]

    def along(self, host: Host) -> Riding:
        """Return the points of all its routes, one route after another, and the kernel's constants.

        Raises:
            UsageError: a point lies outside the body, or too far from its particles.
        """
        found = [_exact(way, host) if host.exact else _tied(way, host) for way in self.ways()]
        x = [of_way for _, of_way in found]
        return Riding(np.concatenate([p for p, _ in found]), np.concatenate(x), self.constants_along(x))

    def constants_along(self, x: list[Array]) -> Array:
        """Return the constants of its kernel, for the points of each route at rest (r, D) [m]."""
        return np.zeros(0)

    def particles(self, part: str, x: Array, inside: Inside) -> Array:
        """Return the particles nearest to the points of its routes, in order."""
        body = self.body  # type: ignore[attr-defined]
        return np.concatenate([particles_along(w.points.tolist(), w.spacing, body, x, inside) for w in self.ways()])

    def rest_length(self, x: Array) -> float:
        """Return the length [m] of a route along points at x (r, D) [m]."""
        return route_length(x)

    def rest_length_vjp(self, x: Array, bar: float) -> Array:
        """Return the cotangent of x (r, D)."""
        return route_length_vjp(x, bar)


def _tied(way: Way, host: Host) -> tuple[Array, Array]:
    """Return the particles along a route, and their positions."""
    route = way.points.tolist()
    particles = particles_along(route, way.spacing, host.body, host.x, host.inside)
    if problem := route_problem(route, host.body, host.x[particles], host.dx):
        raise UsageError(problem)
    return particles, host.x[particles]


def _exact(way: Way, host: Host) -> tuple[Array, Array]:
    """Return the particles that the points of a route ride on, and the points; those on a line may be left out."""
    x, given = subdivided(way.points, way.spacing)
    inside = host.contains(x)
    if not inside[given].all():
        number = int(np.flatnonzero(~inside[given])[0])
        raise UsageError(
            f"its point ({_words(x[given][number])}) lies outside the body '{host.body}' or in a cavity of it: the "
            "points of a route lie in the body, or on its surface; a point of the world is the `anchor` or the "
            "`pulley` of a cable"
        )
    x = x[inside]  # points of a line that lie outside the body would pull where there is nothing
    particles = _nearest(x, host)
    if way.before is not None:
        x, particles = np.concatenate([way.before[None], x]), np.append(WORLD, particles)
    if way.after is not None:
        x, particles = np.concatenate([x, way.after[None]]), np.append(particles, WORLD)
    return particles, x


def subdivided(points: Array, spacing: float | None) -> tuple[Array, Array]:
    """Return the points of a route (n, D) with those at about `spacing` between them, and which were given (n,)."""
    out, given = [points[:1]], [True]
    for begin, end in itertools.pairwise(points):
        length = float(np.linalg.norm(end - begin))
        wanted = 1.0 if spacing is None else length / spacing
        if wanted > MOST_PIECES:
            raise UsageError(
                f"a spacing of {spacing:g} m ties a line of {length:.3g} m at {wanted:.3g} points, more than "
                f"{MOST_PIECES:,}: give one near the distance of its body's particles"
            )
        pieces = max(1, round(wanted))
        out.append(begin + (end - begin) * (np.arange(1, pieces + 1) / pieces)[:, None])
        given += [False] * (pieces - 1) + [True]
    return np.concatenate(out), np.array(given)


def _nearest(x: Array, host: Host) -> Array:
    """Return the nearest particle of the body to each point; UsageError if it is farther than a cell."""
    own = host.inside(host.body, None)
    at = host.x[own]
    out = np.zeros(len(x), np.int64)
    for k, point in enumerate(x):
        square = ((at - point) ** 2).sum(axis=1)
        near = int(np.argmin(square))
        if square[near] > host.dx**2:
            raise UsageError(
                f"its point ({_words(point)}) is {np.sqrt(square[near]):.3g} m from the body '{host.body}', whose "
                f"nearest particle at rest is at ({_words(at[near])}): each point of a route must lie within a cell "
                f"({host.dx:.3g} m) of a particle"
            )
        out[k] = own[near]
    return out


def _words(point: Array) -> str:
    return ", ".join(f"{c + 0.0:.4g}" for c in point)
