"""How far a design is from where it started: a regulariser."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.contract import Array
from cqrun.objectives.design import MASS, STIFFNESS, VOLUME
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Track, TrackBar
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.registry import plugin

ROWS = {"mass": MASS, "volume": VOLUME, "stiffness": STIFFNESS}


@plugin("objective", "unchanged")
class Unchanged(ObjectiveTerm):
    """Mean over a body's particles of (q / q_0 - 1)^2, q a quantity of each and q_0 what it was at the start."""

    least: ClassVar[float] = 0.0

    body: str = Field(description="Body that counts")
    group: str | None = Field(description="Group of the body; the whole body if absent", default=None)
    of: Literal["stiffness", "mass", "volume"] = Field(
        description="Young's modulus, mass or volume at rest", default="stiffness"
    )

    def bind(self, matter: Matter) -> BoundTerm:
        return Bound(self, matter)


class Bound(BoundTerm):
    """The same at every control step."""

    def __init__(self, spec: Unchanged, matter: Matter) -> None:
        self.rows, self.over = means([], matter.n_particles), spec.over
        self.row, self.members = ROWS[spec.of], matter.members(spec.body, spec.group)
        self.start = matter.design[self.row, self.members]

    def steps(self, track: Track) -> Array:
        return np.full(len(track.activation), np.mean(self._change(track) ** 2))

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        design_bar = np.zeros(track.design.shape)
        share = 2.0 * h_bar.sum() / (len(self.members) * self.start)
        design_bar[self.row, self.members] = share * self._change(track)
        return TrackBar(design=design_bar)

    def _change(self, track: Track) -> Array:
        return np.asarray(track.design[self.row, self.members] / self.start - 1.0)
