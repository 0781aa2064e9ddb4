"""The region around one of several markers."""

from __future__ import annotations

from typing import Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.explain import Loc, complaint, finding, listed, suggest
from cqrun.geometry.region import Points, Region
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("region", "nearest_marker")
class NearestMarker(Region):
    """The points that are nearer to one marker than to the others; ties go to the first marker."""

    markers: dict[str, list[float]] = quantity("m", "Name -> position at rest", min_length=2)
    marker: str = Field(description="Name of the marker whose region this is")

    @model_validator(mode="after")
    def _is_one_of_them(self) -> Self:
        if self.marker not in self.markers:
            message = f"there is no marker '{self.marker}'{suggest(self.marker, self.markers)}; "
            place: Loc = ("marker",)
            raise complaint(self.name, [finding(message + f"there are: {listed(self.markers)}", place)])
        return self

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        message = f"must have {dim} entries in this {dim}D world, has "
        return [(("markers", name), f"{message}{len(x)}") for name, x in self.markers.items() if len(x) != dim]

    def pick(self, points: Points) -> Array:
        places = np.array(list(self.markers.values()))
        distances = ((points.x[:, None, :] - places) ** 2).sum(axis=2)
        return np.asarray(distances.argmin(axis=1) == list(self.markers).index(self.marker))
