"""Distance that a body has travelled."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.objectives.axes import AlongAxis, Axis
from cqrun.objectives.term import BoundTerm
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("objective", "distance")
class Distance(AlongAxis):
    """Distance travelled along an axis [m]: a centroid's coordinate (plain mean) minus its value at the start.

    Larger is better.
    """

    sense: ClassVar[Literal[1, -1]] = -1

    body: BodyName = Field(description="Body that travels")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    axis: Axis = Field(description="Axis of the world along which it travels", default="x")

    def bind(self, matter: Matter) -> BoundTerm:
        return CentroidTravel(self, matter)


class CentroidTravel(BoundTerm):
    """Centroid minus centroid at the start."""

    def __init__(self, spec: Distance, matter: Matter) -> None:
        self.rows = means([matter.members(spec.body, spec.group)], matter.n_particles)
        self.over, self.axis = spec.over, spec.index

    def steps(self, track: Track) -> Array:
        along = track.x[:, 0, self.axis]
        return along[1:] - along[0]

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        x_bar = np.zeros(track.x.shape)
        x_bar[1:, 0, self.axis] = h_bar
        x_bar[0, 0, self.axis] = -h_bar.sum()
        return TrackBar(x=x_bar)
