"""An axis-aligned box."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field

from cqrun.boundaries.solid import BOX, Solid
from cqrun.geometry.shape import SLACK, Shape
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.registry import plugin


@plugin("shape", "box")
class Box(Shape):
    """An axis-aligned box (2D: a rectangle): corner <= x <= corner + size."""

    corner: list[float] = vector("m", "Lower corner", geometric=True)
    size: list[Annotated[float, Field(gt=0)]] = vector("m", "Edge lengths", geometric=True)

    def inside(self, points: Array) -> Array:
        lower, upper = self.bounds()
        slack = SLACK * (upper - lower)
        return np.all((points >= lower - slack) & (points <= upper + slack), axis=1)

    def bounds(self) -> tuple[Array, Array]:
        lower = np.array(self.corner)
        return lower, lower + np.array(self.size)

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        stretch = np.array(to.size) / np.array(self.size)
        moved = np.array(to.corner) + (points - np.array(self.corner)) * stretch
        return moved, np.full(len(points), np.prod(stretch))

    def solids(self) -> list[Solid]:
        half = 0.5 * np.array(self.size)
        return [Solid(BOX, (np.array(self.corner) + half)[None], np.eye(len(half)), half)]

    def volume(self) -> float:
        return float(np.prod(self.size))
