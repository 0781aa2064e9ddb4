"""A truncated cone with flat ends; in 2D a trapezoid."""

from __future__ import annotations

import numpy as np

from cqrun.boundaries.solid import CONE, Solid
from cqrun.geometry.segment import SegmentShape
from cqrun.geometry.shape import SLACK
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("shape", "cone")
class Cone(SegmentShape):
    """A tapered round bar with flat ends, from `start` to `end` (2D: a symmetric trapezoid)."""

    start_radius: float = quantity("m", "Radius at the start (2D: half the width)", gt=0, geometric=True)
    end_radius: float = quantity("m", "Radius at the end (2D: half the width)", gt=0, geometric=True)

    @property
    def radii(self) -> tuple[float, float]:
        """The radius [m] at the start and at the end."""
        return self.start_radius, self.end_radius

    def inside(self, points: Array) -> Array:
        fraction, axis = self.along(points)
        reach = self.radius_at(np.clip(fraction, 0, 1)) * (1 + SLACK)
        within = self.distance_squared(points, fraction, axis) <= reach**2
        return within & (fraction >= -SLACK) & (fraction <= 1 + SLACK)

    def bounds(self) -> tuple[Array, Array]:
        ends = np.array([self.start, self.end])
        direction = (ends[1] - ends[0]) / self.length()
        # a disc across `direction` reaches r sqrt(1 - d_i^2) along axis i
        reach = np.outer(self.radii, np.sqrt(np.maximum(1 - direction**2, 0)))
        return (ends - reach).min(axis=0), (ends + reach).max(axis=0)

    def solids(self) -> list[Solid]:
        return [self.solid(CONE, *self.radii)]

    def volume(self) -> float:
        a, b = self.radii
        if len(self.start) == 2:
            return (a + b) * self.length()
        return np.pi / 3 * (a**2 + a * b + b**2) * self.length()
