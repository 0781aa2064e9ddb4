"""Change of a design since the start: a regulariser."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.objectives.design import MASS, RATIO, STIFFNESS, VOLUME
from cqrun.objectives.term import BoundTerm, ObjectiveTerm
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin

POWERS = {
    "mass": {MASS: 1}, "volume": {VOLUME: 1}, "density": {MASS: 1, VOLUME: -1}, "stiffness": {STIFFNESS: 1},
    "poissons_ratio": {RATIO: 1},
}  # fmt: skip
"""Each quantity as a product of powers of rows of the design."""


@plugin("objective", "unchanged")
class Unchanged(ObjectiveTerm):
    """Mean over a body's particles of (q / q_0 - 1)^2, with a quantity q and its value q_0 at the start."""

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body whose change is measured")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    of: Literal["stiffness", "poissons_ratio", "density", "mass", "volume"] = Field(
        description="Young's modulus, Poisson's ratio, density, or mass or volume at rest", default="stiffness"
    )

    def bind(self, matter: Matter) -> BoundTerm:
        return DesignChange(self, matter)


class DesignChange(BoundTerm):
    """The same at every control step."""

    def __init__(self, spec: Unchanged, matter: Matter) -> None:
        self.rows, self.over = means([], matter.n_particles), spec.over
        self.powers, self.members = POWERS[spec.of], matter.members(spec.body, spec.group)
        self.start = self._quantity(matter.design)
        if not np.all(np.abs(self.start) > 0):  # also false for nan, where the material law has no such parameter
            raise UsageError(f"the change of {spec.of} relative to the start is not defined: it is 0 there, or missing")

    def steps(self, track: Track) -> Array:
        return np.full(len(track.activation), np.mean((self._quantity(track.design) / self.start - 1.0) ** 2))

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        design_bar = np.zeros(track.design.shape)
        q = self._quantity(track.design)
        q_bar = 2.0 * h_bar.sum() / (len(self.members) * self.start) * (q / self.start - 1.0)
        for row, power in self.powers.items():
            design_bar[row, self.members] = q_bar * power * q / track.design[row, self.members]
        return TrackBar(design=design_bar)

    def _quantity(self, design: Array) -> Array:
        """Return q for the particles of the body or group (n,)."""
        return np.prod([design[row, self.members] ** power for row, power in self.powers.items()], axis=0)
