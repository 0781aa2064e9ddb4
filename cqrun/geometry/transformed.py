"""A shape that is scaled, rotated and moved."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import Field

from cqrun.boundaries.solid import Solid
from cqrun.geometry.place import Place
from cqrun.geometry.shape import ChosenShape, Shape
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("shape", "transformed")
class Transformed(Place, Shape):
    """A shape in local coordinates: world = offset + scale * rotation * local; it may be nested.

    Its bounds are those of the rotated bounding box, which may be wider than the shape.
    """

    shape: ChosenShape = Field(description="The shape, in local coordinates")

    def inside(self, points: Array) -> Array:
        return self.shape.value.inside(self.to_local(points))

    @property
    def colour_names(self) -> tuple[str, ...]:
        return self.shape.value.colour_names

    @property
    def has_colours(self) -> bool:
        return self.shape.value.has_colours

    def coloured(self, points: Array, colour: str) -> Array:
        return self.shape.value.coloured(self.to_local(points), colour)

    def bounds(self) -> tuple[Array, Array]:
        return self.world_bounds(*self.shape.value.bounds())

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        local, growth = self.shape.value.carried(self.to_local(points), to.shape.value)
        return to.to_world(local), growth * (to.scale / self.scale) ** points.shape[1]

    def solids(self) -> list[Solid]:
        return [self.solid_to_world(solid) for solid in self.shape.value.solids()]

    def volume(self) -> float:
        dim = len(self.shape.value.bounds()[0])
        return float(self.scale**dim * np.float64(self.shape.value.volume()))
