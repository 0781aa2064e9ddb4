"""Length and tension of what runs along a route: a cable, or a spring."""

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
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import ActuatorName, ForceName
from cqrun.plugin.registry import plugin


class OnRoute(Measure):
    """Base of quantities of a cable or a spring."""

    cable: ActuatorName | None = Field(description="Cable, an actuator", default=None)
    spring: ForceName | None = Field(description="Spring, a force; instead of a cable", default=None)

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        if (self.cable is None) == (self.spring is None):
            message = f"needs one of `cable` and `spring`; has {'neither' if self.cable is None else 'both'}"
            raise complaint(type(self).__name__, [finding(message, involves=("cable", "spring"))])
        return self

    def route(self, matter: Matter) -> Route:
        """Return the route; UsageError if what is named does not pull along one."""
        name = self.spring if self.cable is None else self.cable
        assert name is not None
        if name not in matter.routes:
            known = listed(matter.routes) if matter.routes else "none"
            raise UsageError(f"'{name}' is not a cable or a spring; there are: {known}")
        return matter.routes[name]


@plugin("measure", "cable_length")
class CableLength(OnRoute):
    """Length [m] of the route of a cable or a spring, along the particles that it is tied to."""

    def bind(self, matter: Matter) -> BoundMeasure:
        return RouteLength(self.route(matter), matter)


@plugin("measure", "cable_tension")
class CableTension(OnRoute):
    """Tension [N; 2D: N/m] of a cable or a spring, with the activation that acted up to each moment."""

    def bind(self, matter: Matter) -> BoundMeasure:
        return RouteTension(self.route(matter), matter)


class RouteLength(BoundMeasure):
    """Sum of the lengths of the segments, from one row for each particle of the route."""

    unit, meaning = "m", "length of the route"

    def __init__(self, route: Route, matter: Matter) -> None:
        self.rows = single(route.particles, matter.n_particles)
        self.low, self.high = np.zeros(1), np.array([float(np.linalg.norm(matter.size))])

    def values(self, track: Track) -> Array:
        return np.sqrt(np.sum(np.diff(track.x, axis=1) ** 2, axis=2)).sum(axis=1, keepdims=True)

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        """At a segment of length 0 its gradient is taken as 0."""
        gaps = np.diff(track.x, axis=1)
        length = np.sqrt(np.sum(gaps * gaps, axis=2, keepdims=True))
        pulls = bar[:, :, None] * np.divide(gaps, length, out=np.zeros(gaps.shape), where=length > 0.0)
        x_bar = np.zeros(track.x.shape)
        x_bar[:, 1:] += pulls
        x_bar[:, :-1] -= pulls
        return TrackBar(x=x_bar)


class RouteTension(BoundMeasure):
    """The law of the cable or spring (`pull` of its plug-in) for the length of its route."""

    meaning, instant = "tension", False

    def __init__(self, route: Route, matter: Matter) -> None:
        self.length, self.route = RouteLength(route, matter), route
        self.rows = self.length.rows
        self.unit = "N" if matter.dim == 3 else "N/m"
        self.low, self.high = np.zeros(1), np.ones(1)

    def values(self, track: Track) -> Array:
        return np.asarray(self.route.law.pull(*self._levels(track)))[:, None]

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        k, bars = self.route.number, self.route.law.pull_vjp(*self._levels(track), bar[:, 0])
        length_bar, activation_bar, strength_bar, rest_bar = bars
        out: Any = self.length.values_vjp(track, length_bar[:, None])
        out.strength, out.rest_length = np.zeros(track.strength.shape), np.zeros(track.rest_length.shape)
        out.strength[k], out.rest_length[k] = strength_bar.sum(), rest_bar.sum()
        if self.route.activated:
            each = np.zeros((len(track.x), track.activation.shape[1]))
            each[:, k] = activation_bar
            out.activation = during_vjp(track, each)
        return out

    def _levels(self, track: Track) -> tuple[Array, Array, Any, Any]:
        """Return length (T+1,), activation (T+1,), strength and rest length."""
        k, length = self.route.number, self.length.values(track)[:, 0]
        activation = during(track)[:, k] if self.route.activated else np.ones(len(length))
        return length, activation, track.strength[k], track.rest_length[k]
