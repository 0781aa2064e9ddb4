"""Union, difference and intersection of regions: like those of shapes, but also of names and other regions."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from cqrun.boundaries.solid import Solid
from cqrun.geometry.region import ChosenRegion, Points, Region
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("region", "union")
class RegionUnion(Region):
    """The points that any of its regions contains: `union: [legs, {ball: {...}}]`."""

    shorthand: ClassVar[str] = "shapes"

    shapes: list[ChosenRegion] = Field(description="Shapes, names of regions, or other regions", min_length=1)

    def pick(self, points: Points) -> Array:
        return np.any([region.value.pick(points) for region in self.shapes], axis=0)

    def solids(self) -> list[Solid]:
        return [solid for region in self.shapes for solid in region.value.solids()]


@plugin("region", "difference")
class RegionDifference(Region):
    """The points of the first region that none of the others contains: `difference: [body, legs]`."""

    shorthand: ClassVar[str] = "shapes"

    shapes: list[ChosenRegion] = Field(description="A region, then the regions to remove from it", min_length=2)

    def pick(self, points: Points) -> Array:
        first, *others = (region.value.pick(points) for region in self.shapes)
        return first & ~np.any(others, axis=0)


@plugin("region", "intersection")
class RegionIntersection(Region):
    """The points that all of its regions contain: `intersection: [legs, {half_space: {...}}]`."""

    shorthand: ClassVar[str] = "shapes"

    shapes: list[ChosenRegion] = Field(description="Regions that must all contain a point", min_length=1)

    def pick(self, points: Points) -> Array:
        return np.all([region.value.pick(points) for region in self.shapes], axis=0)
