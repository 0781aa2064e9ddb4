"""A polygon, in 2D.

Own code, although shapely could do it: the test is the one loop below, it needs no further package, and it says
what a polygon that crosses itself holds, which shapely calls invalid.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from cqrun.contract import Array, quantity
from cqrun.explain import Loc
from cqrun.geometry.shape import Shape
from cqrun.registry import plugin

Corner = Annotated[list[float], Field(min_length=2, max_length=2)]


@plugin("shape", "polygon")
class Polygon(Shape):
    """A polygon through `points` in order (2D only); where it crosses itself the even-odd rule decides."""

    points: list[Corner] = quantity("m", "Corners in order, [x, y] each", min_length=3)

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [] if dim == 2 else [((), "a polygon needs a 2D world; use box, capsule or cylinder in 3D")]

    def inside(self, points: Array) -> Array:
        """Return which points (N, 2) a ray towards +x leaves through an odd number of edges: (N,) bool."""
        x, y = points[:, 0], points[:, 1]
        result = np.zeros(len(points), bool)
        corners = np.array(self.points)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            if y0 != y1:
                crosses = (y0 > y) != (y1 > y)
                result ^= crosses & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
        return result

    def bounds(self) -> tuple[Array, Array]:
        corners = np.array(self.points)
        return corners.min(axis=0), corners.max(axis=0)
