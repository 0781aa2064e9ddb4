"""Height of a body."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.objectives.axes import AlongAxis
from cqrun.objectives.term import BoundTerm, Over
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("objective", "height")
class Height(AlongAxis):
    """Height of a centroid (plain mean): its coordinate along an axis of the world [m]. Larger is better."""

    sense: ClassVar[Literal[1, -1]] = -1

    body: BodyName = Field(description="Body that is measured")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    over: Over = Field(description="How the values of all control steps are combined", default="mean")

    def bind(self, matter: Matter) -> BoundTerm:
        return CentroidHeight(self, matter)


class CentroidHeight(BoundTerm):
    """One coordinate of a centroid."""

    def __init__(self, spec: Height, matter: Matter) -> None:
        self.rows = means([matter.members(spec.body, spec.group)], matter.n_particles)
        self.over, self.axis = spec.over, spec.index

    def steps(self, track: Track) -> Array:
        return track.x[1:, 0, self.axis]

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        x_bar = np.zeros(track.x.shape)
        x_bar[1:, 0, self.axis] = h_bar
        return TrackBar(x=x_bar)
