"""An ellipse, or an ellipsoid in 3D: a shape of your own."""

from __future__ import annotations

import numpy as np

from cqrun.geometry.shape import SLACK, Shape
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.registry import plugin


@plugin("shape", "my_shape")
class MyShape(Shape):
    """An ellipse (3D: an ellipsoid) with its axes along those of the world: the sum of ((x - center) / radii)^2 is 1.

    This text is the page of the shape: `cqrun describe shape my_shape --plugin my_shape.py`.
    """

    center: list[float] = vector("m", "Centre")
    radii: list[float] = vector("m", "Half the length along each axis of the world")

    def inside(self, points: Array) -> Array:
        """Return which points (N, D) [m] are in the shape: (N,) bool."""
        offset = (points - np.array(self.center)) / np.array(self.radii)
        return np.asarray(np.sum(offset**2, axis=1) <= (1 + SLACK) ** 2)

    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper corner (D,) [m] of a box around the shape."""
        center, radii = np.array(self.center), np.abs(self.radii)
        return center - radii, center + radii
