"""Position of a place on a body, its displacement and its velocity."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from cqrun.measures.measure import AXES, BoundMeasure
from cqrun.measures.place import AtPlace
from cqrun.observers.matter import Matter
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("measure", "position")
class Position(AtPlace):
    """Position [m] of a point of the material, or of the centroid (plain mean) of a body, group or region."""

    def bind(self, matter: Matter) -> BoundMeasure:
        return PlaceMotion(self, matter, "x", np.zeros(matter.dim), "position", "m", 0.0 * matter.size)


@plugin("measure", "displacement")
class Displacement(AtPlace):
    """Displacement [m] of a point, or of the centroid of a body, group or region, from its place in the rest shape.

    The rest shape is that of the scene's start values.
    """

    def bind(self, matter: Matter) -> BoundMeasure:
        rest = self.row(matter) @ matter.x
        return PlaceMotion(self, matter, "x", rest[0], "displacement from rest", "m", -1.0 * matter.size)


@plugin("measure", "velocity")
class Velocity(AtPlace):
    """Velocity [m/s] of a point, or of the centroid of a body, group or region."""

    needs_time: ClassVar[bool] = True

    def bind(self, matter: Matter) -> BoundMeasure:
        return PlaceMotion(self, matter, "v", np.zeros(matter.dim), "velocity", "m/s", -1.0 * matter.size)


class PlaceMotion(BoundMeasure):
    """A sum of positions, or of velocities, minus a constant.

    Args:
        field: x or v.
        origin: what is subtracted (D,).
        low: lower end of the usual range (D,); the upper one is the size of the world.
    """

    def __init__(
        self, spec: AtPlace, matter: Matter, field: str, origin: Array, meaning: str, unit: str, low: Array
    ) -> None:
        self.rows, self.components = spec.row(matter), tuple(AXES[: matter.dim])
        self.field, self.origin, self.meaning, self.unit = field, origin, meaning, unit
        self.low, self.high = low, 1.0 * matter.size

    def values(self, track: Track) -> Array:
        return np.asarray(getattr(track, self.field)[:, 0] - self.origin)

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        return TrackBar(x=bar[:, None]) if self.field == "x" else TrackBar(v=bar[:, None])
