"""What capsules and cylinders share: a segment from start to end, with a radius."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import model_validator

from cqrun.contract import Array, quantity, vector
from cqrun.explain import complaint, finding
from cqrun.geometry.shape import Shape


class SegmentShape(Shape):
    """A shape around the segment from `start` to `end`."""

    start: list[float] = vector("m", "First end of the axis")
    end: list[float] = vector("m", "Other end of the axis")
    radius: float = quantity("m", "Radius", gt=0)

    @model_validator(mode="after")
    def _has_length(self) -> Self:
        if len(self.start) != len(self.end):
            raise complaint(self.name, [finding("must have as many entries as start", ("end",))])
        if self.start == self.end:
            raise complaint(self.name, [finding("must differ from start", ("end",), involves=("start",))])
        return self

    def length(self) -> float:
        """Return the length of the axis [m]."""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    def along(self, points: Array) -> tuple[Array, Array]:
        """Return where points (N, D) fall on the axis, 0 at start to 1 at end: (N,); and the axis (D,)."""
        axis = np.subtract(self.end, self.start)
        return (points - np.array(self.start)) @ axis / (axis @ axis), axis

    def distance_squared(self, points: Array, fraction: Array, axis: Array) -> Array:
        """Return the squared distance (N,) [m^2] of points (N, D) from the axis at `fraction` (N,)."""
        offset = points - np.array(self.start) - fraction[:, None] * axis
        return np.einsum("nd,nd->n", offset, offset)
