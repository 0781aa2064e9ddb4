"""A half-space: all points behind a plane."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import AfterValidator

from cqrun.boundaries.solid import PLANE, Solid
from cqrun.geometry.shape import Shape, slack_at
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.registry import plugin


def _unit(normal: list[float]) -> list[float]:
    """Scale a vector to length 1; one that has this length already is returned unchanged."""
    length = float(np.linalg.norm(normal))
    if length == 0:
        raise ValueError("must not be zero: it points out of the half-space")
    return normal if abs(length - 1) <= 1e-15 else [component / length for component in normal]


@plugin("shape", "half_space")
class HalfSpace(Shape):
    """All points behind a plane (2D: a line): (x - point) . normal <= 0. The normal points outward."""

    point: list[float] = vector("m", "A point on the plane")
    normal: Annotated[list[float], AfterValidator(_unit)] = vector("1", "Outward normal, scaled to length 1")

    def inside(self, points: Array) -> Array:
        slack = slack_at(points) + slack_at(np.array([self.point]))
        return (points - np.array(self.point)) @ np.array(self.normal) <= slack

    def bounds(self) -> tuple[Array, Array]:
        """Return the bounds: infinite, except at the plane if its normal is along an axis."""
        lower, upper = np.full(len(self.point), -np.inf), np.full(len(self.point), np.inf)
        along = np.flatnonzero(self.normal)
        if len(along) == 1:
            axis = along[0]
            (upper if self.normal[axis] > 0 else lower)[axis] = self.point[axis]
        return lower, upper

    def solids(self) -> list[Solid]:
        return [Solid(PLANE, np.array([self.point], float), np.array([self.normal], float), np.zeros(0))]

    def volume(self) -> float:
        return float("inf")
