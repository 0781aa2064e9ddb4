"""Force or moment of a boundary."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from cqrun.measures.measure import AXES, BoundMeasure, Measure
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BoundaryName
from cqrun.plugin.registry import plugin
from cqrun.units import force_units

STANDARD_GRAVITY = 9.80665
"""[m/s^2]"""


@plugin("measure", "reaction")
class Reaction(Measure):
    """Force [N] or moment [N m] with which a boundary acts on the bodies, or with which they act on it.

    It is the mean over each control step, so it has no value at the start; at rest, it is that of the equilibrium. It
    needs the reference frame. A moment is about the same point as that of the objective `reaction`. 2D: [N/m], [N].
    """

    boundary: BoundaryName = Field(description="Boundary whose force or moment it is")
    of: Literal["force", "moment"] = Field(description="Which of the two", default="force")
    on: Literal["body", "boundary"] = Field(
        description="On what it acts: on the bodies, or on the boundary, as a load cell behind it shows", default="body"
    )

    @property
    def boundaries(self) -> tuple[str, ...]:
        """The boundary whose reactions it needs."""
        return (self.boundary,)

    def bind(self, matter: Matter) -> BoundMeasure:
        return BoundaryReaction(self, matter)


class BoundaryReaction(BoundMeasure):
    """Columns of what a boundary does."""

    def __init__(self, spec: Reaction, matter: Matter) -> None:
        self.rows, dim, is_force = means([], matter.n_particles), matter.dim, spec.of == "force"
        self.boundary, self.sign = spec.boundary, 1.0 if spec.on == "body" else -1.0
        self.columns = slice(0, dim) if is_force else slice(dim, None)
        self.components = tuple(AXES[:dim]) if is_force or dim == 3 else ("",)
        self.unit = force_units(dim)[0 if is_force else 1]
        self.meaning = f"{spec.of} on the {'bodies' if spec.on == 'body' else 'boundary'}"
        # the weight of all bodies, and its moment with the size of the world as arm: scales that every scene has
        usual = STANDARD_GRAVITY * float(matter.mass.sum()) * (1.0 if is_force else float(np.linalg.norm(matter.size)))
        self.high = np.full(len(self.components), usual)
        self.low = -self.high

    def values(self, track: Track) -> Array:
        out = self.sign * track.held[self.boundary][:, self.columns]
        out[0] = np.nan
        return np.asarray(out)

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        held_bar = np.zeros(track.held[self.boundary].shape)
        held_bar[1:, self.columns] = self.sign * bar[1:]
        return TrackBar(held={self.boundary: held_bar})
