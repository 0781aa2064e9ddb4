"""A capsule: all points within a radius of a segment; the radius may change along it."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from pydantic import model_validator

from cqrun.boundaries.solid import CAPSULE, TAPER, Solid
from cqrun.explain import complaint, finding
from cqrun.geometry.segment import EvenSegment
from cqrun.geometry.shape import SLACK
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("shape", "capsule")
class Capsule(EvenSegment):
    """A cylinder with round ends (2D: a stadium): points within `radius` of the segment start-end.

    With `end_radius` it is tapered: the smallest convex body around a ball of `radius` at the start and a ball of
    `end_radius` at the end.
    """

    end_radius: float | None = quantity(
        "m", "Radius at the end; that at the start if absent", gt=0, geometric=True, default=None,
        exclude_if=lambda radius: radius is None,  # so that scenes without it keep the names of their runs
    )  # fmt: skip

    @model_validator(mode="after")
    def _has_two_ends(self) -> Self:
        start, end = self.radii
        if abs(end - start) >= self.length() * (1 - SLACK):
            message = (
                f"is {end:g}, and the radius {start:g}: they must differ by less than the length of {self.length():g}, "
                "or one end lies inside the other"
            )
            raise complaint(self.name, [finding(message, ("end_radius",), involves=("radius",))])
        return self

    @property
    def radii(self) -> tuple[float, float]:
        """The radius [m] at the start and at the end."""
        return self.radius, self.radius if self.end_radius is None else self.end_radius

    def inside(self, points: Array) -> Array:
        fraction, axis = self.along(points)
        if self.end_radius is not None:  # the centre of the ball that reaches farthest towards each point
            sine, cosine, length = self._slant()
            fraction = fraction - np.sqrt(self.distance_squared(points, fraction, axis)) * sine / (cosine * length)
        core = np.clip(fraction, 0, 1)
        return self.distance_squared(points, core, axis) <= (self.radius_at(core) * (1 + SLACK)) ** 2

    def bounds(self) -> tuple[Array, Array]:
        ends, reach = np.array([self.start, self.end]), np.array(self.radii)[:, None]
        return (ends - reach).min(axis=0), (ends + reach).max(axis=0)

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        """Move each cross-section along the axis and scale it with its radius: both caps, and what lies between."""
        if self.end_radius is None:
            return super().carried(points, to)
        fraction, axis = self.along(points)
        sine, cosine, length = self._slant()
        sine_to, cosine_to, length_to = to._slant()
        (r, q), (r_to, q_to), y = self.radii, to.radii, fraction * length
        low, high = r * sine, length + q * sine  # the cone touches the balls here
        low_to, high_to = r_to * sine_to, length_to + q_to * sine_to
        # a cap's radius is sqrt((r + y) (r - y)), and r + y from its pole is stretched evenly
        foot, cap = np.minimum(y, low), (r_to + low_to) / (r + low)
        foot_to = (r + foot) * cap - r_to
        first = foot_to, cap, np.sqrt(cap * (r_to - foot_to) / (r - foot))
        side, stretch = np.clip(y, low, high), (high_to - low_to) / (high - low)
        side_to = low_to + (side - low) * stretch
        middle = side_to, stretch, (r_to - sine_to * side_to) / cosine_to / ((r - sine * side) / cosine)
        head, cap = np.maximum(y, high) - length, (q_to - q_to * sine_to) / (q - q * sine)
        head_to = q_to - (q - head) * cap
        last = length_to + head_to, cap, np.sqrt(cap * (q_to + head_to) / (q + head))
        parts = [y < low, y <= high, np.ones(len(y), bool)]
        along, slope, scale = (_chosen(parts, each) for each in zip(first, middle, last, strict=True))
        offset = self.turned(points - np.array(self.start) - fraction[:, None] * axis, to)
        axis_to = np.subtract(to.end, to.start) / length_to
        x = np.array(to.start) + along[:, None] * axis_to + scale[:, None] * offset
        return x, slope * scale ** (len(self.start) - 1)

    def solids(self) -> list[Solid]:
        return [self.solid(CAPSULE, self.radius) if self.end_radius is None else self.solid(TAPER, *self.radii)]

    def volume(self) -> float:
        (r, q), dim = self.radii, len(self.start)
        s, c, length = self._slant()
        if dim == 2:
            start, end = np.pi / 2 + np.arcsin(s) + s * c, np.pi / 2 - np.arcsin(s) - s * c
            return float(r**2 * start + q**2 * end + (r + q) * c * length * c**2)
        start, end = ((radius * h) ** 2 * radius * (3 - h) / 3 for radius, h in ((r, 1 + s), (q, 1 - s)))
        return float(np.pi * (start + end + (r**2 + r * q + q**2) * c**2 / 3 * length * c**2))

    def _slant(self) -> Any:
        """Return the sine and the cosine of the angle between the side and the axis, and the length of the axis [m]."""
        start, end = self.radii
        axis = np.subtract(self.end, self.start)
        length = np.sqrt(axis @ axis)
        sine = (start - end) / length
        return sine, np.sqrt(1.0 - sine * sine), length


def _chosen(parts: list[Array], values: Any) -> Array:
    """Return for each point the value of the first part that contains it."""
    return np.asarray(np.select(parts, [np.broadcast_to(value, parts[0].shape) for value in values]))
