"""A ball, or a disc in 2D."""

from __future__ import annotations

import numpy as np

from cqrun.contract import Array, quantity, vector
from cqrun.geometry.shape import Shape
from cqrun.registry import plugin


@plugin("shape", "ball")
class Ball(Shape):
    """A ball (2D: a disc): |x - center| <= radius."""

    center: list[float] = vector("m", "Centre")
    radius: float = quantity("m", "Radius", gt=0)

    def inside(self, points: Array) -> Array:
        offset = points - np.array(self.center)
        return np.einsum("nd,nd->n", offset, offset) <= self.radius**2

    def bounds(self) -> tuple[Array, Array]:
        center = np.array(self.center)
        return center - self.radius, center + self.radius

    def volume(self) -> float:
        return np.pi * self.radius**2 * (1.0 if len(self.center) == 2 else 4 / 3 * self.radius)
