"""Kinetic energy of a part of a body."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from cqrun.measures.measure import BoundMeasure
from cqrun.measures.place import OnPart
from cqrun.objectives.design import MASS
from cqrun.observers.matter import Matter
from cqrun.observers.rows import single
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("measure", "kinetic_energy")
class KineticEnergy(OnPart):
    """Kinetic energy sum of m |v|^2 / 2 over the particles of a part [J; 2D: J/m].

    The finest waves of the grid, which the particles average, are not in it.
    """

    needs_time: ClassVar[bool] = True

    def bind(self, matter: Matter) -> BoundMeasure:
        return MotionEnergy(self, matter)


class MotionEnergy(BoundMeasure):
    """Sum over one row for each particle."""

    meaning, instant = "kinetic energy", False

    def __init__(self, spec: KineticEnergy, matter: Matter) -> None:
        self.members = spec.members(matter)
        self.rows = single(self.members, matter.n_particles)
        self.unit = "J" if matter.dim == 3 else "J/m"

    def values(self, track: Track) -> Array:
        squared = np.sum(track.v * track.v, axis=2)
        return 0.5 * (squared @ track.design[MASS, self.members])[:, None]

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        mass, design_bar = track.design[MASS, self.members], np.zeros(track.design.shape)
        design_bar[MASS, self.members] = 0.5 * bar[:, 0] @ np.sum(track.v * track.v, axis=2)
        return TrackBar(v=bar[:, :, None] * mass[:, None] * track.v, design=design_bar)
