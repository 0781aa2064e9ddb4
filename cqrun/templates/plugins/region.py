"""Stripes: a region of your own. A region selects particles (or grid nodes) by where they are at rest."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.geometry.region import Points, Region
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("region", "my_region")
class MyRegion(Region):
    """Every second stripe of a width, counted from the origin along an axis.

    This text is the page of the region: `cqrun describe region my_region --plugin my_region.py`.
    """

    width: float = quantity("m", "Width of a stripe", gt=0)
    axis: int = Field(description="Axis across the stripes: 0 for x, 1 for y, 2 for z", ge=0, le=2, default=0)

    def pick(self, points: Points) -> Array:
        """Return which points the region contains: (N,) bool; points.x are their positions (N, D) [m]."""
        return np.asarray(np.floor(points.x[:, self.axis] / self.width) % 2 == 0)
