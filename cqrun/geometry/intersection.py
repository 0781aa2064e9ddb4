"""An intersection of shapes."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np
from pydantic import Field

from cqrun.geometry.shape import ChosenShape, Shape, coloured_parts
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("shape", "intersection")
class Intersection(Shape):
    """The points that all of its shapes contain: `intersection: [shape, ...]`.

    If a field of the first shape is an unknown, particles follow that shape, and the cuts by the others move and
    stretch with it.
    """

    shorthand: ClassVar[str] = "shapes"

    shapes: list[ChosenShape] = Field(description="Shapes that must all contain a point", min_length=1)

    def inside(self, points: Array) -> Array:
        return np.all([part.value.inside(points) for part in self.shapes], axis=0)

    @property
    def colour_names(self) -> tuple[str, ...]:
        return tuple(name for part in self.shapes for name in part.value.colour_names)

    @property
    def has_colours(self) -> bool:
        return any(part.value.has_colours for part in self.shapes)

    def coloured(self, points: Array, colour: str) -> Array:
        return np.any(coloured_parts([part.value for part in self.shapes], points, colour), axis=0)

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        return self.shapes[0].value.carried(points, to.shapes[0].value)

    def bounds(self) -> tuple[Array, Array]:
        lower, upper = zip(*(part.value.bounds() for part in self.shapes), strict=True)
        return np.max(lower, axis=0), np.min(upper, axis=0)
