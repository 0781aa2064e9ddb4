"""A ball, or a disc in 2D."""

from __future__ import annotations

from typing import Self

import numpy as np

from cqrun.boundaries.solid import CAPSULE, Solid
from cqrun.geometry.shape import SLACK, Shape
from cqrun.plugin.contract import Array, quantity, vector
from cqrun.plugin.registry import plugin


@plugin("shape", "ball")
class Ball(Shape):
    """A ball (2D: a disc): |x - center| <= radius."""

    center: list[float] = vector("m", "Centre", geometric=True)
    radius: float = quantity("m", "Radius", gt=0, geometric=True)

    def inside(self, points: Array) -> Array:
        offset = points - np.array(self.center)
        return np.einsum("nd,nd->n", offset, offset) <= (self.radius * (1 + SLACK)) ** 2

    def bounds(self) -> tuple[Array, Array]:
        center = np.array(self.center)
        return center - self.radius, center + self.radius

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        stretch = to.radius / self.radius
        moved = np.array(to.center) + (points - np.array(self.center)) * stretch
        return moved, np.full(len(points), stretch ** len(self.center))

    def solids(self) -> list[Solid]:
        ends = np.tile(np.array(self.center, float), (2, 1))
        return [Solid(CAPSULE, ends, np.zeros((0, ends.shape[1])), np.array([self.radius]))]

    def volume(self) -> float:
        return np.pi * self.radius**2 * (1.0 if len(self.center) == 2 else 4 / 3 * self.radius)
