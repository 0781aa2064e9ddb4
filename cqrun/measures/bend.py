"""Bend angle between two parts of a body."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.measurements.rotation import axial
from cqrun.measures.measure import BoundMeasure, Measure
from cqrun.measures.turning import angle, rotation_vector, turned, turned_vjp, turning_rows, unwrapped
from cqrun.observers.matter import Matter
from cqrun.observers.rows import stacked
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import GroupName, OnlyBodyName
from cqrun.plugin.registry import plugin


@plugin("measure", "bend")
class Bend(Measure):
    """Bend angle [rad] of a body: how much one of its groups has turned relative to another since rest.

    Each rotation is the best rigid fit to the particles of the group. In 2D the angle is positive from x to y, and it
    counts full turns on. In 3D it is the angle of the relative rotation, from 0 to pi; where it is 0, its gradient is
    taken as 0.
    """

    body: OnlyBodyName = Field(description="Body that bends; may be omitted if the scene has only one")
    group: GroupName = Field(description="Group, or region of the scene, that the angle is relative to")
    to_group: GroupName = Field(description="Group, or region of the scene, whose rotation is measured")

    def bind(self, matter: Matter) -> BoundMeasure:
        return RelativeTurn(self, matter)


class RelativeTurn(BoundMeasure):
    """The angle of R_b R_a^T for the rotations of two parts."""

    unit, meaning = "rad", "bend angle"

    def __init__(self, spec: Bend, matter: Matter) -> None:
        parts = [matter.members(spec.body, group) for group in (spec.group, spec.to_group)]
        self.rows = stacked([turning_rows(matter, part) for part in parts], matter.n_particles)
        self.dim = matter.dim
        self.high = np.full(1, np.pi)
        self.low = -self.high if matter.dim == 2 else 0.0 * self.high

    def values(self, track: Track) -> Array:
        relative = self._relative(track)[2]
        return self.continuous(rotation_vector(relative)) if self.dim == 2 else angle(relative)[:, None]

    def values_vjp(self, track: Track, bar: Array) -> TrackBar:
        first, second, relative = self._relative(track)
        phi_bar = bar
        if self.dim == 3:  # a small turn of the second part changes the angle by its part along the axis
            axis = axial(relative)
            length = np.linalg.norm(axis, axis=1, keepdims=True)
            phi_bar = bar * np.divide(axis, length, out=np.zeros(axis.shape), where=length > 0.0)
        x, D = track.x, self.dim
        bars = turned_vjp(x[:, :D], first, -phi_bar), turned_vjp(x[:, D:], second, phi_bar)
        return TrackBar(x=np.concatenate(bars, axis=1))

    def continuous(self, values: Array) -> Array:
        return unwrapped(values) if self.dim == 2 else values

    def _relative(self, track: Track) -> tuple[Array, Array, Array]:
        """Return the rotations of both parts, and that of the second relative to the first (T, D, D)."""
        first, second = turned(track.x[:, : self.dim]), turned(track.x[:, self.dim :])
        return first, second, second @ np.swapaxes(first, -1, -2)
