"""Base of capsules, cylinders and cones: a segment from start to end, with radii."""

from __future__ import annotations

from abc import abstractmethod
from typing import Self

import numpy as np
from pydantic import model_validator

from cqrun.boundaries.solid import Solid
from cqrun.explain import complaint, finding
from cqrun.geometry.shape import Shape
from cqrun.plugin.contract import Array, quantity, vector


class SegmentShape(Shape):
    """A shape around the segment from `start` to `end`, whose radius is linear along the segment."""

    start: list[float] = vector("m", "First end of the axis", geometric=True)
    end: list[float] = vector("m", "Other end of the axis", geometric=True)

    @property
    @abstractmethod
    def radii(self) -> tuple[float, float]:
        """The radius [m] at the start and at the end."""

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

    def radius_at(self, fraction: Array) -> Array:
        """Return the radius (N,) [m] at `fraction` (N,) of the axis."""
        start, end = self.radii
        return np.asarray(start + (end - start) * fraction)

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        """Stretch along the axis, rotate with it, and scale distances from the segment with the radius there."""
        fraction, axis = self.along(points)
        core = np.clip(fraction, 0.0, 1.0)
        start, axis_to = np.array(to.start), np.subtract(to.end, to.start)
        stretch = np.sqrt(axis_to @ axis_to) / self.length()
        turned = self.turned(points - np.array(self.start) - core[:, None] * axis, to)
        scale, dim = to.radius_at(core) / self.radius_at(core), len(self.start)
        growth = np.where(core == fraction, stretch, scale) * scale ** (dim - 1)
        return start + core[:, None] * axis_to + scale[:, None] * turned, growth

    def turned(self, offset: Array, to: Self) -> Array:
        """Return vectors (N, D) turned by the smallest rotation from its unit axis d to that of `to`, d'.

        R v = v - (d + d') (d + d').v / (1 + d.d') + 2 d' d.v.
        """
        axis, axis_to = np.subtract(self.end, self.start), np.subtract(to.end, to.start)
        d, d_to = axis / np.sqrt(axis @ axis), axis_to / np.sqrt(axis_to @ axis_to)
        both = d + d_to
        turned = offset - np.outer(offset @ both / (1.0 + d @ d_to), both) + 2.0 * np.outer(offset @ d, d_to)
        return np.asarray(turned)

    def solid(self, kind: int, *lengths: float) -> Solid:
        """Return it as a solid of a kind with some lengths [m]."""
        ends = np.array([self.start, self.end], float)
        return Solid(kind, ends, np.zeros((0, ends.shape[1])), np.array(lengths))

    def along(self, points: Array) -> tuple[Array, Array]:
        """Return the projections (N,) of points (N, D) on the axis, 0 at start and 1 at end, and the axis (D,)."""
        axis = np.subtract(self.end, self.start)
        return (points - np.array(self.start)) @ axis / (axis @ axis), axis

    def distance_squared(self, points: Array, fraction: Array, axis: Array) -> Array:
        """Return the squared distance (N,) [m^2] of points (N, D) from the axis at `fraction` (N,)."""
        offset = points - np.array(self.start) - fraction[:, None] * axis
        return np.einsum("nd,nd->n", offset, offset)


class EvenSegment(SegmentShape):
    """A shape around a segment with the same radius everywhere."""

    radius: float = quantity("m", "Radius", gt=0, geometric=True)

    @property
    def radii(self) -> tuple[float, float]:
        """The radius [m] at the start and at the end."""
        return self.radius, self.radius
