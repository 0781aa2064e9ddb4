"""A capsule: all points within a radius of a segment."""

from __future__ import annotations

import numpy as np

from cqrun.boundaries.solid import CAPSULE, Solid
from cqrun.geometry.segment import EvenSegment
from cqrun.geometry.shape import SLACK
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("shape", "capsule")
class Capsule(EvenSegment):
    """A cylinder with round ends (2D: a stadium): points within `radius` of the segment start-end."""

    def inside(self, points: Array) -> Array:
        fraction, axis = self.along(points)
        return self.distance_squared(points, np.clip(fraction, 0, 1), axis) <= (self.radius * (1 + SLACK)) ** 2

    def bounds(self) -> tuple[Array, Array]:
        ends = np.array([self.start, self.end])
        return ends.min(axis=0) - self.radius, ends.max(axis=0) + self.radius

    def solids(self) -> list[Solid]:
        return [self.solid(CAPSULE, self.radius)]

    def volume(self) -> float:
        r, length = self.radius, self.length()
        if len(self.start) == 2:
            return 2 * r * length + np.pi * r**2
        return np.pi * r**2 * (length + 4 / 3 * r)
