"""Length and tension of what runs along a route: a cable, or a spring.

A point of a route rides on a particle, x_s = x_p + F_p (X_s - X_p), or is fixed in the world.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import complaint, finding, listed
from cqrun.measures.measure import BoundMeasure, Measure, during, during_vjp
from cqrun.observers.matter import Matter, Route
from cqrun.observers.rows import single
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.reference import ActuatorName, ForceName
from cqrun.plugin.registry import plugin


class OnRoute(Measure):
    """Base of quantities of a cable or a spring."""

    cable: ActuatorName | None = Field(description="Cable, an actuator", default=None)
    spring: ForceName | None = Field(description="Spring, a force; instead of a cable", default=None)
    route: int = Field(description="Which of several routes on one spool, counted from 0", ge=0, default=0)

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        if (self.cable is None) == (self.spring is None):
            message = f"needs one of `cable` and `spring`; has {'neither' if self.cable is None else 'both'}"
            raise complaint(type(self).__name__, [finding(message, involves=("cable", "spring"))])
        return self

    def chosen(self, matter: Matter) -> Route:
        """Return the route; UsageError if what is named does not pull along one."""
        name = self.spring if self.cable is None else self.cable
        assert name is not None
        name = f"{name}.{self.route}" if self.route else name
        if name not in matter.routes:
            known = listed(matter.routes) if matter.routes else "none"
            raise UsageError(f"'{name}' is not a cable or a spring; there are: {known}")
        return matter.routes[name]


@plugin("measure", "cable_length")
class CableLength(OnRoute):
    """Length [m] of the route of a cable or a spring."""

    def bind(self, matter: Matter) -> BoundMeasure:
        return RouteLength(self.chosen(matter), matter)


@plugin("measure", "cable_tension")
class CableTension(OnRoute):
    """Tension [N; 2D: N/m] of a cable or a spring, with the activation that acted up to each moment.

    It is that at the driven end, the first point of the route, or at the part `at` of its length at rest. They differ
    if the cable has friction.
    """

    at: float = quantity(
        "1", "Part of the length at rest from the first point on; 1 is the far end", ge=0, le=1, default=0
    )

    def bind(self, matter: Matter) -> BoundMeasure:
        return RouteTension(self.chosen(matter), matter, self.at)


class RouteShape:
    """The points of a route, its segments, and the angles by which it bends at its points, and their adjoint."""

    def __init__(self, route: Route, matter: Matter) -> None:
        self.rides = route.particles >= 0
        self.plain = route.offsets is None and bool(self.rides.all())
        count = len(route.particles)
        self.offsets = np.zeros((count, matter.dim)) if route.offsets is None else route.offsets
        self.rows = single(route.particles[self.rides], matter.n_particles)

    def points(self, track: Track) -> Array:
        """Return the points (T+1, n, D) [m]."""
        if self.plain:
            return track.x
        out = np.broadcast_to(self.offsets, (len(track.x), *self.offsets.shape)).astype(track.x.dtype)
        out[:, self.rides] = track.x + np.einsum("tnij,nj->tni", track.F, self.offsets[self.rides])
        return out

    def points_vjp(self, bar: Array) -> TrackBar:
        """Return the cotangent of the track from that of the points."""
        if self.plain:
            return TrackBar(x=bar)
        own = bar[:, self.rides]
        return TrackBar(x=own, F=np.einsum("tni,nj->tnij", own, self.offsets[self.rides]))

    def segments(self, track: Track) -> tuple[Array, Array]:
        """Return the segments' lengths (T+1, n-1) [m] and unit vectors (T+1, n-1, D); those without length have 0."""
        gaps = np.diff(self.points(track), axis=1)
        length = np.sqrt(np.sum(gaps * gaps, axis=2))
        unit = np.divide(gaps, length[..., None], out=np.zeros(gaps.shape), where=length[..., None] > 0.0)
        return length, unit

    def segments_vjp(self, track: Track, length_bar: Array, unit_bar: Array | None = None) -> TrackBar:
        """Return the cotangent of the track from those of lengths and unit vectors."""
        length, unit = self.segments(track)
        gaps_bar = length_bar[..., None] * unit
        if unit_bar is not None:
            across = unit_bar - (unit_bar * unit).sum(axis=2, keepdims=True) * unit
            gaps_bar += np.divide(across, length[..., None], out=np.zeros(unit.shape), where=length[..., None] > 0.0)
        bar = np.zeros((len(track.x), *self.offsets.shape))
        bar[:, 1:] += gaps_bar
        bar[:, :-1] -= gaps_bar
        return self.points_vjp(bar)


def turned(unit: Array) -> Array:
    """Return by how much a route has turned before each segment: the sum of its angles (T+1, n-1), for unit vectors."""
    return np.asarray(np.cumsum(np.pad(_angles(unit)[0], ((0, 0), (1, 0))), axis=1))


def turned_vjp(unit: Array, bar: Array) -> Array:
    """Return the cotangent of the unit vectors; where a route is straight the angle's derivative is taken as 0."""
    angle_bar = np.cumsum(bar[:, ::-1], axis=1)[:, ::-1][:, 1:]
    _, cosine, sine = _angles(unit)
    scale = -np.divide(angle_bar, sine, out=np.zeros(sine.shape), where=sine > 0.0)[..., None]
    out = np.zeros(unit.shape)
    out[:, :-1] += scale * (unit[:, 1:] - cosine[..., None] * unit[:, :-1])
    out[:, 1:] += scale * (unit[:, :-1] - cosine[..., None] * unit[:, 1:])
    return out


def _angles(unit: Array) -> tuple[Array, Array, Array]:
    """Return the angles between segments, their cosines and their sines (T+1, n-2)."""
    a, b = unit[:, :-1], unit[:, 1:]
    cosine = (a * b).sum(axis=2)
    if unit.shape[2] == 2:
        sine = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
    else:
        sine = np.linalg.norm(np.cross(a, b), axis=2)
    return np.arctan2(sine, cosine), cosine, sine


class RouteLength(BoundMeasure):
    """Sum of the lengths of the segments, from one row for each particle that a point of the route rides on."""

    unit, meaning = "m", "length of the route"

    def __init__(self, route: Route, matter: Matter) -> None:
        self.shape = RouteShape(route, matter)
        self.rows = self.shape.rows
        self.low, self.high = np.zeros(1), np.array([float(np.linalg.norm(matter.size))])

    def values(self, track: Track) -> Array:
        return np.sqrt(np.sum(np.diff(self.shape.points(track), axis=1) ** 2, axis=2)).sum(axis=1, keepdims=True)

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        """At a segment of length 0 its gradient is taken as 0."""
        count = len(self.shape.offsets) - 1
        return self.shape.segments_vjp(track, np.broadcast_to(bar, (len(bar), count)))


class RouteTension(BoundMeasure):
    """The law of the cable or spring (`pull` of its plug-in) for the length of its route, and what friction leaves."""

    meaning = "tension"

    def __init__(self, route: Route, matter: Matter, at: float = 0.0) -> None:
        self.length, self.route = RouteLength(route, matter), route
        self.shape, self.rows = self.length.shape, self.length.rows
        self.segment = segment_at(route, at) if at > 0.0 and getattr(route.law, "friction", None) is not None else 0
        self.unit = "N" if matter.dim == 3 else "N/m"
        largest = usual_tension(route, matter)
        self.low, self.high = np.array([0.0 if route.activated else -largest]), np.array([largest])

    def values(self, track: Track) -> Array:
        return np.asarray(self.route.law.pull(*self._levels(track)) * self._left(track))[:, None]

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        k, levels, left = self.route.number, self._levels(track), self._left(track)
        length_bar, activation_bar, strength_bar, rest_bar = self.route.law.pull_vjp(*levels, bar[:, 0] * left)
        out: Any = self.length.values_vjp(track, length_bar[:, None])
        out.strength, out.rest_length = np.zeros(track.strength.shape), np.zeros(track.rest_length.shape)
        out.strength[k], out.rest_length[k] = strength_bar.sum(), rest_bar.sum()
        if self.route.activated:
            each = np.zeros((len(track.x), track.activation.shape[1]))
            each[:, k] = self.route.turn * activation_bar
            out.activation = during_vjp(track, each)
        if self.segment:
            self._add_friction(track, bar[:, 0] * self.route.law.pull(*levels) * left, out)
        return out

    def _add_friction(self, track: Track, log_bar: Array, out: TrackBar) -> None:
        """Add the cotangents of friction and angles, from that of the logarithm of what friction leaves."""
        length, unit = self.shape.segments(track)
        along, k = turned(unit), self.route.number
        turned_bar = np.zeros(along.shape)
        turned_bar[:, self.segment] = -track.friction[k] * log_bar
        by_angles = self.shape.segments_vjp(track, 0.0 * length, turned_vjp(unit, turned_bar))
        out.x = out.x + by_angles.x  # type: ignore[operator]
        out.F = None if out.F is None else out.F + by_angles.F
        out.friction = np.zeros(track.friction.shape)
        out.friction[k] = -(log_bar * along[:, self.segment]).sum()

    def _left(self, track: Track) -> Array:
        """Return the part of the tension at the driven end that friction leaves (T+1,)."""
        if not self.segment:
            return np.ones(len(track.x))
        return np.exp(-track.friction[self.route.number] * turned(self.shape.segments(track)[1])[:, self.segment])

    def _levels(self, track: Track) -> tuple[Array, Array, Any, Any]:
        """Return length (T+1,), activation (T+1,), strength and rest length."""
        k, length = self.route.number, self.length.values(track)[:, 0]
        activation = during(track)[:, k] if self.route.activated else np.ones(len(length))
        level = self.route.begin + self.route.turn * activation
        return length, level, track.strength[k], track.rest_length[k]


def usual_tension(route: Route, matter: Matter) -> float:
    """Return the tension of a cable of its length at rest that is pulled in wholly, or of a spring of twice its length.

    1 N if there is none.
    """
    if not len(matter.strength) or not len(matter.rest_length):
        return 1.0
    strength, rest = matter.strength[route.number], matter.rest_length[route.number]
    lengths, activations = np.array([rest, rest] if route.activated else [2.0 * rest] * 2), np.array([0.0, 1.0])
    found = float(np.max(route.law.pull(lengths, activations, strength, rest)))
    return found if found > 0.0 else 1.0


def segment_at(route: Route, at: float) -> int:
    """Return the segment of a route at a part of its length at rest."""
    if route.rest is None:
        return round(at * (len(route.particles) - 2))
    length = np.linalg.norm(np.diff(route.rest, axis=0), axis=1)
    ends = np.cumsum(length) / length.sum()
    return min(int(np.searchsorted(ends, at - 1e-12)), len(length) - 1)
