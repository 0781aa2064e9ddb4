"""Rotation of a part of a body."""

from __future__ import annotations

import numpy as np

from cqrun.measures.measure import AXES, BoundMeasure
from cqrun.measures.place import OnPart
from cqrun.measures.turning import (
    rotation_vector,
    rotation_vector_vjp,
    turned,
    turned_vjp,
    turning_rows,
    unwrapped,
)
from cqrun.observers.matter import Matter
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("measure", "rotation")
class Rotation(OnPart):
    """Rotation vector [rad] of a body, group or region from rest, by the best rigid fit to its particles.

    In 2D it is one angle, positive from x to y. In 3D its direction is the axis and its length the angle; it counts
    full turns on, and its gradient grows without bound near a full turn. With `position` of the same part it is the
    pose of that part.
    """

    def bind(self, matter: Matter) -> BoundMeasure:
        return PartTurn(self, matter)


class PartTurn(BoundMeasure):
    """The rotation vector of the best fit."""

    unit, meaning = "rad", "rotation from rest"

    def __init__(self, spec: Rotation, matter: Matter) -> None:
        self.rows = turning_rows(matter, spec.members(matter))
        self.components = ("",) if matter.dim == 2 else tuple(AXES)
        self.high = np.full(len(self.components), np.pi)
        self.low = -self.high

    def values(self, track: Track) -> Array:
        return self.continuous(rotation_vector(turned(track.x)))

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        R = turned(track.x)
        r = self.continuous(rotation_vector(R))
        return TrackBar(x=turned_vjp(track.x, R, rotation_vector_vjp(r, bar)))

    def continuous(self, values: Array) -> Array:
        return unwrapped(values)
