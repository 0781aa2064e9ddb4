"""An axis-aligned box."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from cqrun.contract import Array, vector
from cqrun.geometry.shape import Shape
from cqrun.registry import plugin

_SLACK = 1e-9
"""Of the box's size: a grid node on a face belongs to it, however 0.1 + 0.2 was rounded."""


@plugin("shape", "box")
class Box(Shape):
    """An axis-aligned box (2D: a rectangle): corner <= x <= corner + size."""

    corner: list[float] = vector("m", "Lower corner")
    size: list[Annotated[float, Field(gt=0)]] = vector("m", "Edge lengths")

    def inside(self, points: Array) -> Array:
        lower, upper = self.bounds()
        slack = _SLACK * (upper - lower)
        return np.all((points >= lower - slack) & (points <= upper + slack), axis=1)

    def bounds(self) -> tuple[Array, Array]:
        lower = np.array(self.corner)
        return lower, lower + np.array(self.size)

    def volume(self) -> float:
        return float(np.prod(self.size))
