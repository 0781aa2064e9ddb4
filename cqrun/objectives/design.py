"""Terms of the design alone: sums over properties of the particles, the same at every control step."""

from __future__ import annotations

import numpy as np

from cqrun.objectives.term import BoundTerm, Over
from cqrun.observers.matter import Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array

DESIGN = ("mass", "volume", "youngs_modulus", "poissons_ratio")
"""Rows of `Track.design` (Q, N) for every particle: mass [kg], volume at rest [m^D], elastic parameters [Pa], [1]."""

MASS, VOLUME, STIFFNESS, RATIO = range(len(DESIGN))


class DesignSum(BoundTerm):
    """A weighted sum over one row of the design.

    Args:
        row: index of a row of the design.
        members: indices of the particles in the sum.
        weight: weight of each of these particles.
    """

    def __init__(self, matter: Matter, over: Over, row: int, members: Array, weight: float = 1.0) -> None:
        self.rows, self.over = means([], matter.n_particles), over
        self.row, self.members, self.weight = row, members, weight

    def steps(self, track: Track) -> Array:
        return np.full(len(track.activation), self.weight * track.design[self.row, self.members].sum())

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        design_bar = np.zeros(track.design.shape)
        design_bar[self.row, self.members] = self.weight * h_bar.sum()
        return TrackBar(design=design_bar)
