"""A cylinder with flat ends, in 3D."""

from __future__ import annotations

import numpy as np

from cqrun.boundaries.solid import CONE, Solid
from cqrun.explain import Loc
from cqrun.geometry.segment import EvenSegment
from cqrun.geometry.shape import SLACK
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("shape", "cylinder")
class Cylinder(EvenSegment):
    """A round bar with flat ends, from `start` to `end` (3D only; in 2D use a polygon)."""

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        if dim != 3:
            return [((), "a cylinder needs a 3D world; use polygon or capsule in 2D")]
        return super().dim_problems(dim)

    def inside(self, points: Array) -> Array:
        fraction, axis = self.along(points)
        within = self.distance_squared(points, fraction, axis) <= (self.radius * (1 + SLACK)) ** 2
        return within & (fraction >= -SLACK) & (fraction <= 1 + SLACK)

    def bounds(self) -> tuple[Array, Array]:
        ends = np.array([self.start, self.end])
        direction = (ends[1] - ends[0]) / self.length()
        # a disc across `direction` reaches r sqrt(1 - d_i^2) along axis i
        reach = self.radius * np.sqrt(np.maximum(1 - direction**2, 0))
        return ends.min(axis=0) - reach, ends.max(axis=0) + reach

    def solids(self) -> list[Solid]:
        return [self.solid(CONE, *self.radii)]

    def volume(self) -> float:
        return np.pi * self.radius**2 * self.length()
