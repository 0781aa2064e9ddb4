"""Depth of particles below a height that they should stay above."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from cqrun.geometry.region import ChosenRegion
from cqrun.objectives.axes import AlongAxis
from cqrun.objectives.term import BoundTerm, Over
from cqrun.observers.matter import Matter
from cqrun.observers.rows import single
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.reference import BodyName
from cqrun.plugin.registry import plugin


@plugin("objective", "contact_free")
class ContactFree(AlongAxis):
    """Mean over a region's particles of max(0, height + margin - y)^2 [m^2], y their coordinate along the axis.

    It is zero if all particles are above `height` by the margin. It records every particle of the region at every
    control step.
    """

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body that should touch nothing")
    region: ChosenRegion | None = Field(description="Region, at rest; the whole body if absent", default=None)
    height: float = quantity("m", "Height that the particles must stay above, along the axis")
    margin: float = quantity("m", "Required distance above this height", ge=0, default=0.0)
    over: Over = Field(description="How the values of all control steps are combined", default="mean")

    def bind(self, matter: Matter) -> BoundTerm:
        return SquaredDepth(self, matter)


class SquaredDepth(BoundTerm):
    """Mean of the squared depth over the rows, one for each particle."""

    def __init__(self, spec: ContactFree, matter: Matter) -> None:
        self.rows = single(matter.within(spec.body, spec.region), matter.n_particles)
        self.over, self.axis, self.clear = spec.over, spec.index, spec.height + spec.margin

    def steps(self, track: Track) -> Array:
        depth = self._depth(track)
        return np.asarray(np.mean(depth * depth, axis=1))

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        depth = self._depth(track)
        x_bar = np.zeros(track.x.shape)
        x_bar[1:, :, self.axis] = (-2.0 / depth.shape[1]) * h_bar[:, None] * depth
        return TrackBar(x=x_bar)

    def _depth(self, track: Track) -> Array:
        """Return how deep each particle is (T, K) [m]; 0 if it is high enough."""
        depth = self.clear - track.x[1:, :, self.axis]
        return np.where(depth.real > 0, depth, 0.0)
