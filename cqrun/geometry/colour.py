"""The region of one colour of a body made from an image."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from cqrun.geometry.region import Points, Region
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("region", "colour")
class Colour(Region):
    """The particles in pixels of one colour of the image from which their body is made."""

    shorthand: ClassVar[str] = "colour"
    of_particles: ClassVar[bool] = True

    colour: str = Field(description="One of the image's named colours, or #rrggbb")

    def pick(self, points: Points) -> Array:
        return points.coloured(self.colour)
