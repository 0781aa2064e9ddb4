"""What a controller spends."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from cqrun.contract import Array
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Over, Track, TrackBar
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.registry import plugin


@plugin("objective", "effort")
class Effort(ObjectiveTerm):
    """Effort [s]: the integral over time of u^T u, the sum of all activations' squares."""

    least: ClassVar[float] = 0.0

    over: Over = Field(description="How the values of all control steps become one", default="sum")

    def bind(self, matter: Matter) -> BoundTerm:
        return Bound(self, matter)


class Bound(BoundTerm):
    """u^T u of every control step."""

    def __init__(self, spec: Effort, matter: Matter) -> None:
        self.rows = means([], matter.n_particles)
        self.over = spec.over

    def steps(self, track: Track) -> Array:
        return np.asarray(np.sum(track.activation * track.activation, axis=1))

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        return TrackBar(activation=2.0 * h_bar[:, None] * track.activation)
