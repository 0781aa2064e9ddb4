"""Speed of a body that should be at rest."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from cqrun.objectives.term import BoundTerm, ObjectiveTerm
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means, single
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("objective", "rest")
class Rest(ObjectiveTerm):
    """Squared speed [m^2/s^2] of a centroid (plain mean); or, with `particles: true`, its mean over all particles.

    CQ1's arm is brought to rest with `particles: true`, which records every particle at every control step.
    """

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body that should be at rest")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    particles: bool = Field(
        description="Mean of the particles' squared speeds instead of the centroid's", default=False
    )

    def bind(self, matter: Matter) -> BoundTerm:
        return MeanSquaredSpeed(self, matter)


class MeanSquaredSpeed(BoundTerm):
    """Mean of |v|^2 over the rows: one for the centroid, or one for each particle."""

    def __init__(self, spec: Rest, matter: Matter) -> None:
        chosen = matter.members(spec.body, spec.group)
        self.rows = single(chosen, matter.n_particles) if spec.particles else means([chosen], matter.n_particles)
        self.over = spec.over

    def steps(self, track: Track) -> Array:
        v = track.v[1:]
        return np.asarray(np.sum(v * v, axis=(1, 2)) / v.shape[1])

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        v_bar = np.zeros(track.v.shape)
        v_bar[1:] = (2.0 / track.v.shape[1]) * h_bar[:, None, None] * track.v[1:]
        return TrackBar(v=v_bar)
