"""Volume and pressure of a chamber."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.forces.wall import enclosed, enclosed_vjp
from cqrun.measures.measure import BoundMeasure, Measure, during, during_vjp
from cqrun.observers.matter import Matter, Wall
from cqrun.observers.rows import single
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import ActuatorName
from cqrun.plugin.registry import plugin


class OfChamber(Measure):
    """Base of quantities of a chamber."""

    chamber: ActuatorName = Field(description="Chamber, an actuator")
    part: str | None = Field(description="Name in its `each`, if it has parts", default=None)

    def wall(self, matter: Matter) -> Wall:
        """Return the chamber's wall; UsageError if there is none of this name."""
        name = self.chamber if self.part is None else f"{self.chamber}.{self.part}"
        if name not in matter.walls:
            known = listed(matter.walls) if matter.walls else "none"
            raise UsageError(f"'{name}' is not a chamber; there are: {known}")
        return matter.walls[name]


@plugin("measure", "chamber_volume")
class ChamberVolume(OfChamber):
    """Volume [m^3; 2D: m^2] of a chamber, or of all cavities on its line."""

    def bind(self, matter: Matter) -> BoundMeasure:
        return WallVolume(self.wall(matter), matter)


@plugin("measure", "chamber_pressure")
class ChamberPressure(OfChamber):
    """Pressure [Pa] in a chamber above that around the body, with the activation that acted up to each moment."""

    def bind(self, matter: Matter) -> BoundMeasure:
        return WallPressure(self.wall(matter), matter)


class WallVolume(BoundMeasure):
    """The volume in the wall's points, x = x_p + F_p (X - X_p), from one row for each."""

    meaning = "volume of the chamber"

    def __init__(self, wall: Wall, matter: Matter) -> None:
        self.rows, self.wall = single(wall.particles, matter.n_particles), wall
        self.unit = f"m^{matter.dim}"
        size = float(enclosed(matter.x[wall.particles] + wall.offsets, wall.facets))
        self.low, self.high = np.zeros(1), np.array([2.0 * size])

    def values(self, track: Track) -> Array:
        return np.asarray(enclosed(self._points(track), self.wall.facets))[:, None]

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        x_bar = enclosed_vjp(self._points(track), self.wall.facets, bar[:, 0])
        return TrackBar(x=x_bar, F=x_bar[..., :, None] * self.wall.offsets[:, None, :])

    def _points(self, track: Track) -> Array:
        return np.asarray(track.x + np.einsum("tkij,kj->tki", track.F, self.wall.offsets))


class WallPressure(BoundMeasure):
    """The law of the chamber (`gauge` of its plug-in) for its volume."""

    meaning, unit = "pressure above that around the body", "Pa"

    def __init__(self, wall: Wall, matter: Matter) -> None:
        self.volume, self.wall = WallVolume(wall, matter), wall
        self.rows = self.volume.rows
        self.low, self.high = np.zeros(1), np.array([usual_pressure(wall, matter)])

    def values(self, track: Track) -> Array:
        return np.asarray(self.wall.law.gauge(*self._levels(track)))[:, None]

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        k, bars = self.wall.number, self.wall.law.gauge_vjp(*self._levels(track), bar[:, 0])
        volume_bar, activation_bar, strength_bar, rest_bar = bars
        out: Any = self.volume.values_vjp(track, volume_bar[:, None])
        out.strength, out.rest_length = np.zeros(track.strength.shape), np.zeros(track.rest_length.shape)
        out.strength[k], out.rest_length[k] = strength_bar.sum(), rest_bar.sum()
        each = np.zeros((len(track.x), track.activation.shape[1]))
        each[:, k] = activation_bar
        out.activation = during_vjp(track, each)
        return out

    def _levels(self, track: Track) -> tuple[Array, Array, Any, Any]:
        """Return volume (T+1,), activation (T+1,), strength and rest volume."""
        k = self.wall.number
        return self.volume.values(track)[:, 0], during(track)[:, k], track.strength[k], track.rest_length[k]


def usual_pressure(wall: Wall, matter: Matter) -> float:
    """Return the pressure [Pa] at an activation of 1 in a chamber that keeps its volume; 1 bar if there is none."""
    if not len(matter.strength) or not len(matter.rest_length):
        return 1.0e5
    strength, rest = matter.strength[wall.number], matter.rest_length[wall.number]
    found = float(wall.law.gauge(rest, 1.0, strength, rest))
    return found if found > 0.0 else 1.0e5
