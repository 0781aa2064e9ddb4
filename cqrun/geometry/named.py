"""A region by its name."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from cqrun.geometry.region import Points, Region
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import RegionName
from cqrun.plugin.registry import plugin


@plugin("region", "named")
class Named(Region):
    """A group of the body, or else one of the scene's `regions`: `region: legs`."""

    shorthand: ClassVar[str] = "region"
    stands_alone: ClassVar[bool] = True
    is_name: ClassVar[bool] = True

    region: RegionName = Field(
        description="Name of a group, a part or a colour of the body, or of a region of the scene"
    )

    def pick(self, points: Points) -> Array:
        return points.named(self.region)
