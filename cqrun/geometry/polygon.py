"""A polygon, in 2D.

The test for points inside is written here, although shapely has one: it is a single loop, it needs no other package,
and it is defined for polygons that cross themselves, which shapely refuses. If corners are unknowns, shapely divides
the polygon into triangles.
"""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field

from cqrun.boundaries.solid import POLYGON, Solid
from cqrun.errors import MissingExtra, UsageError
from cqrun.explain import Loc
from cqrun.geometry.shape import SLACK, Shape
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin

Corner = Annotated[list[float], Field(min_length=2, max_length=2)]


@plugin("shape", "polygon")
class Polygon(Shape):
    """A polygon through `points` in order (2D only). If it crosses itself, the even-odd rule applies."""

    points: list[Corner] = quantity("m", "Corners in order, [x, y] each", geometric=True, min_length=3)

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [] if dim == 2 else [((), "a polygon needs a 2D world; use box, capsule or cylinder in 3D")]

    def inside(self, points: Array) -> Array:
        """Return which points (N, 2) lie on an edge, or have an odd number of edges in direction +x: (N,) bool."""
        x, y = points[:, 0], points[:, 1]
        result, on_edge = np.zeros((2, len(points)), bool)
        corners = np.array(self.points)
        slack = SLACK * float(np.ptp(corners, axis=0).max())
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            (x0, y0), (x1, y1) = start, end
            near = np.flatnonzero((abs(x - (x0 + x1) / 2) <= abs(x1 - x0) / 2 + slack)
                                  & (abs(y - (y0 + y1) / 2) <= abs(y1 - y0) / 2 + slack))  # fmt: skip
            on_edge[near] |= _beside(points[near], start, end) <= slack
            if y0 != y1:
                crosses = (y0 > y) != (y1 > y)
                result ^= crosses & (x < x0 + (y - y0) * ((x1 - x0) / (y1 - y0)))
        return result | on_edge

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        """Move each point with the triangle of corners in which it lies."""
        triangles = self._triangles()
        a, b, c = np.array(self.points)[triangles].transpose(1, 0, 2)
        weight_b = cross(points[:, None] - a, c - a) / cross(b - a, c - a)
        weight_c = cross(b - a, points[:, None] - a) / cross(b - a, c - a)
        weights = np.stack([1.0 - weight_b - weight_c, weight_b, weight_c], axis=2)
        chosen = weights.min(axis=2).argmax(axis=1)  # on an edge of two triangles either will do
        a_to, b_to, c_to = np.array(to.points)[triangles].transpose(1, 0, 2)
        growth = cross(b_to - a_to, c_to - a_to) / cross(b - a, c - a)
        corners_to = np.stack([a_to, b_to, c_to], axis=1)[chosen]
        return np.einsum("nk,nkd->nd", weights[np.arange(len(points)), chosen], corners_to), growth[chosen]

    def solids(self) -> list[Solid]:
        return [Solid(POLYGON, np.zeros((1, 2)), np.eye(2), np.array(self.points, float).ravel())]

    def _triangles(self) -> Array:
        """Return the corners' indices (T, 3) of triangles that fill the polygon.

        Raises:
            MissingExtra: shapely is not installed. UsageError: the polygon crosses itself.
        """
        try:
            import shapely  # type: ignore[import-untyped]
        except ImportError:
            raise MissingExtra(
                "corners of a polygon as unknowns need shapely, which is not installed: pip install 'cqrun[polygon]'"
            ) from None
        whole = shapely.Polygon(self.points)
        if not whole.is_valid:
            raise UsageError("a polygon whose corners are unknowns must not cross or touch itself")
        number = {tuple(corner): k for k, corner in enumerate(self.points)}
        parts = shapely.constrained_delaunay_triangles(whole).geoms
        return np.array([[number[corner] for corner in part.exterior.coords[:3]] for part in parts])

    def bounds(self) -> tuple[Array, Array]:
        corners = np.array(self.points)
        return corners.min(axis=0), corners.max(axis=0)


def _beside(points: Array, start: Array, end: Array) -> Array:
    """Return the distance (N,) [m] of points (N, 2) from the line through an edge, or from an edge of length 0."""
    edge, offset = end - start, points - start
    length = np.hypot(*edge)
    return np.asarray(np.abs(cross(edge, offset)) / length if length > 0 else np.hypot(*offset.T))


def cross(a: Array, b: Array) -> Array:
    """Return the cross products of plane vectors (..., 2)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
