"""Work that an actuator does on the bodies.

An activation is constant in a control step, and then the forces of every actuator have a potential: a cable stores
energy, a muscle's stress F S is the derivative of S : F^T F / 2. So the work in a control step is exactly what the
potential loses in it, whatever the way between its two ends. The potential changes with the activation from one step to
the next, which does no work on the bodies.

A cable that rubs has no potential. Its work in a control step is that of the mean tension of each segment at both ends
of the step, whose error is of the third order in the step's change.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.measures.cable import RouteLength, RouteShape, turned, turned_vjp
from cqrun.measures.chamber import WallVolume
from cqrun.measures.measure import BoundMeasure, Measure
from cqrun.objectives.design import MASS, VOLUME
from cqrun.observers.matter import ActuatorPart, Matter, Route, Wall
from cqrun.observers.rows import single, slices, stacked
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import ActuatorName
from cqrun.plugin.registry import plugin


@plugin("measure", "work")
class Work(Measure):
    """Work [J; 2D: J/m] that an actuator has done on the bodies since the start, with all its parts.

    It is exact for the motion at the control steps, but for a cable with friction, where it takes the mean tensions of
    each control step. It is negative where the bodies drive the actuator back.
    """

    needs_time = True

    actuator: ActuatorName = Field(description="Actuator that works")

    def bind(self, matter: Matter) -> BoundMeasure:
        parts = [part for part in matter.parts if part.actuator == self.actuator]
        works: list[BoundMeasure] = []
        for part in parts:
            if part.name in matter.routes:
                routes = [route for route in matter.routes.values() if route.law is matter.routes[part.name].law]
                rubs = getattr(part.law, "friction", None) is not None
                works += [
                    RubbedWork(route, matter) if rubs else StoredWork(route, RouteLength(route, matter))
                    for route in routes
                ]
            elif part.name in matter.walls:
                wall = matter.walls[part.name]
                works.append(StoredWork(wall, WallVolume(wall, matter)))
            elif hasattr(part.law, "potential"):
                works.append(PartWork(part, matter))
            else:
                raise UsageError(f"the work of '{part.law.name}' is not known: its class needs `potential`")
        return TotalWork(works, matter)


class TotalWork(BoundMeasure):
    """The sum of the works of an actuator's parts."""

    meaning, instant, cumulative = "work done on the bodies", False, True

    def __init__(self, works: list[BoundMeasure], matter: Matter) -> None:
        self.works = works
        self.rows = stacked([work.rows for work in works], matter.n_particles)
        self.places = slices([work.rows.shape[0] for work in works])
        self.unit = "J" if matter.dim == 3 else "J/m"

    def values(self, track: Track) -> Array:
        return np.asarray(sum(w.values(track.part(at)) for w, at in zip(self.works, self.places, strict=True)))

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        total = TrackBar(x=np.zeros(track.x.shape), F=np.zeros(track.F.shape), activation=0.0 * track.activation)
        for work, at in zip(self.works, self.places, strict=True):
            part: Any = work.values_vjp(track.part(at), bar)
            for name in ("x", "F"):
                if getattr(part, name) is not None:
                    getattr(total, name)[:, at] = getattr(part, name)
            total.activation = total.activation + part.activation
            total.add_inputs_of(part)
        return total


class Stepwise(BoundMeasure):
    """A sum over the control steps of what each has done: row 0 is 0."""

    meaning, unit, instant, cumulative = "work", "J", False, True


def accumulated(each: Array) -> Array:
    """Return sums (T+1, 1) over the steps so far of what each step adds (T,)."""
    return np.concatenate([np.zeros(1), np.cumsum(each)])[:, None]


def accumulated_vjp(bar: Array) -> Array:
    """Return the cotangent of what each step adds (T,)."""
    return np.asarray(np.cumsum(bar[:0:-1, 0])[::-1])


class StoredWork(Stepwise):
    """What the energy of a cable or chamber loses in each control step with the activation of that step.

    The energy depends on one number of the motion: the length of a route, or the volume of a chamber.
    """

    def __init__(self, of: Route | Wall, size: BoundMeasure) -> None:
        self.size, self.of = size, of
        self.rows = size.rows

    def values(self, track: Track) -> Array:
        size, levels = self.size.values(track)[:, 0], self._levels(track)
        before, after = (self.of.law.stored(each, *levels) for each in (size[:-1], size[1:]))
        return accumulated(before - after)

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        k, size, levels = self.of.number, self.size.values(track)[:, 0], self._levels(track)
        each = accumulated_vjp(bar)
        size_bar = np.zeros(len(size))
        out = TrackBar(strength=np.zeros(track.strength.shape), rest_length=np.zeros(track.rest_length.shape))
        out.activation = np.zeros(track.activation.shape)
        for rows, sign in ((slice(None, -1), 1.0), (slice(1, None), -1.0)):
            by = self.of.law.stored_vjp(size[rows], *levels, sign * each)
            size_bar[rows] += by[0]
            out.activation[:, k] += self.of.turn * by[1]
            out.strength[k] += by[2].sum()  # type: ignore[index]
            out.rest_length[k] += by[3].sum()  # type: ignore[index]
        moved = self.size.values_vjp(track, size_bar[:, None])
        out.x, out.F = moved.x, moved.F
        return out

    def _levels(self, track: Track) -> tuple[Array, Any, Any]:
        k = self.of.number
        activation = self.of.begin + self.of.turn * track.activation[:, k]
        return activation, track.strength[k], track.rest_length[k]


class RubbedWork(Stepwise):
    """What the mean tension of each segment of a cable with friction does as the segment becomes shorter."""

    def __init__(self, route: Route, matter: Matter) -> None:
        self.shape, self.route = RouteShape(route, matter), route
        self.rows = self.shape.rows

    def values(self, track: Track) -> Array:
        length, unit = self.shape.segments(track)
        shorter, left = length[:-1] - length[1:], self._left(track, unit)
        tensions = (self._driven(track, length, rows)[:, None] * left[rows] for rows in (slice(-1), slice(1, None)))
        return accumulated(np.sum(0.5 * sum(tensions) * shorter, axis=1))

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        k, (length, unit), each = self.route.number, self.shape.segments(track), accumulated_vjp(bar)[:, None]
        shorter, left, along = length[:-1] - length[1:], self._left(track, unit), turned(unit)
        length_bar, turned_bar = np.zeros(length.shape), np.zeros(length.shape)
        out = TrackBar(strength=np.zeros(track.strength.shape), rest_length=np.zeros(track.rest_length.shape))
        out.activation, out.friction = np.zeros(track.activation.shape), np.zeros(track.friction.shape)
        for rows in (slice(-1), slice(1, None)):
            driven = self._driven(track, length, rows)
            pulled = 0.5 * each * driven[:, None] * left[rows]
            length_bar[:-1] += pulled
            length_bar[1:] -= pulled
            turned_bar[rows] -= track.friction[k] * pulled * shorter
            out.friction[k] -= (pulled * shorter * along[rows]).sum()
            driven_bar = (0.5 * each * left[rows] * shorter).sum(axis=1)
            by = self.route.law.pull_vjp(length[rows].sum(axis=1), *self._levels(track), driven_bar)
            length_bar[rows] += by[0][:, None]
            out.activation[:, k] += self.route.turn * by[1]
            out.strength[k] += by[2].sum()  # type: ignore[index]
            out.rest_length[k] += by[3].sum()  # type: ignore[index]
        moved = self.shape.segments_vjp(track, length_bar, turned_vjp(unit, turned_bar))
        out.x, out.F = moved.x, moved.F
        return out

    def _left(self, track: Track, unit: Array) -> Array:
        """Return the part of the tension at the driven end that friction leaves each segment (T+1, n-1)."""
        return np.exp(-track.friction[self.route.number] * turned(unit))

    def _driven(self, track: Track, length: Array, rows: slice) -> Array:
        """Return the tension at the driven end at the beginning or the end of every control step (T,)."""
        return self.route.law.pull(length[rows].sum(axis=1), *self._levels(track))

    def _levels(self, track: Track) -> tuple[Array, Any, Any]:
        k, route = self.route.number, self.route
        return route.begin + route.turn * track.activation[:, k], track.strength[k], track.rest_length[k]


class PartWork(Stepwise):
    """Level times weight times volume (or mass) times what the potential of each particle loses."""

    def __init__(self, part: ActuatorPart, matter: Matter) -> None:
        self.part = part
        self.rows = single(part.particles, matter.n_particles)
        self.per = MASS if part.law.per == "mass" else VOLUME
        self.room = np.ones(len(part.particles)) if self.per == MASS else matter.room[part.particles]

    def values(self, track: Track) -> Array:
        k = self.part.number
        return accumulated(track.activation[:, k] * track.strength[k] * self._lost(track))

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        k, each, lost = self.part.number, accumulated_vjp(bar), self._lost(track)
        amount, weight = track.design[self.per, self.part.particles] / self.room, self._weight(track)
        level = track.activation[:, k] * track.strength[k]
        phi = self._potential(track)
        out = TrackBar(activation=np.zeros(track.activation.shape), strength=np.zeros(track.strength.shape))
        out.activation[:, k] = each * track.strength[k] * lost  # type: ignore[index]
        out.strength[k] = (each * track.activation[:, k] * lost).sum()  # type: ignore[index]
        by_particle = (each * level) @ (phi[:-1] - phi[1:])
        out.design = np.zeros(track.design.shape)
        out.design[self.per, self.part.particles] = by_particle * weight / self.room
        if len(track.weights):
            out.weights = np.zeros(track.weights.shape)
            out.weights[self.part.weights] = by_particle * amount
        phi_bar = np.zeros(phi.shape)
        phi_bar[:-1] += (each * level)[:, None] * weight * amount
        phi_bar[1:] -= (each * level)[:, None] * weight * amount
        out.x, out.F = self.part.law.potential_vjp(self.part.constants, track.x, track.F, phi_bar)
        return out

    def _potential(self, track: Track) -> Array:
        """Return the potential of every particle (T+1, n), for a level, weight and volume of 1."""
        return np.asarray(self.part.law.potential(self.part.constants, track.x, track.F))

    def _weight(self, track: Track) -> Array:
        return track.weights[self.part.weights] if len(track.weights) else np.ones(len(self.part.particles))

    def _lost(self, track: Track) -> Array:
        """Return what the potential of all particles loses in each control step (T,), for a level of 1."""
        phi = self._potential(track)
        amount = track.design[self.per, self.part.particles] / self.room
        return np.asarray((phi[:-1] - phi[1:]) @ (self._weight(track) * amount))
