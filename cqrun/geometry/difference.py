"""A shape with others cut out of it."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field

from cqrun.geometry.shape import ChosenShape, Shape
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("shape", "difference")
class Difference(Shape):
    """The points of the first shape that none of the others contains: `difference: [shape, hole, ...]`.

    If a field of the first shape is an unknown, particles follow that shape, so holes move and stretch with it.
    """

    shorthand: ClassVar[str] = "shapes"

    shapes: list[ChosenShape] = Field(description="A shape, then the shapes to cut out of it", min_length=2)

    def inside(self, points: Array) -> Array:
        first, *holes = (part.value for part in self.shapes)
        result = first.inside(points)
        for hole in holes:
            result &= ~hole.inside(points)
        return result

    @property
    def colour_names(self) -> tuple[str, ...]:
        return self.shapes[0].value.colour_names

    @property
    def has_colours(self) -> bool:
        return self.shapes[0].value.has_colours

    def coloured(self, points: Array, colour: str) -> Array:
        return self.shapes[0].value.coloured(points, colour)

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        return self.shapes[0].value.carried(points, to.shapes[0].value)

    def bounds(self) -> tuple[Array, Array]:
        return self.shapes[0].value.bounds()
