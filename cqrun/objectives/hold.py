"""Whether a gripper holds a rigid body: how fast the body slips, and whether it is lifted."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.objectives.axes import AlongAxis
from cqrun.objectives.gaps import lengths, lengths_vjp
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Over
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.reference import BodyName, GroupName, RigidName
from cqrun.plugin.registry import plugin

ROUNDING = 1e-9


class OfRigid(ObjectiveTerm):
    """Base of terms of a rigid body that count for some time."""

    least: ClassVar[float] = 0.0

    rigid: RigidName = Field(description="Rigid body that is held")
    begin: float = quantity("s", "From when on it counts; its value is 0 before", ge=0, default=0.0)
    end: float | None = quantity("s", "Until when it counts; to the end of the run if absent", gt=0, default=None)


class CountedForSomeTime(BoundTerm):
    """A term whose values are zero at other times."""

    def __init__(self, spec: OfRigid, matter: Matter) -> None:
        ends = np.arange(1, matter.n_controls + 1) * matter.control_step
        end = np.inf if spec.end is None else spec.end
        self.counts = (ends >= spec.begin * (1 - ROUNDING)) & (ends <= end * (1 + ROUNDING))
        if not self.counts.any():
            until = "" if spec.end is None else f" to {spec.end:g}"
            raise UsageError(
                f"counts from {spec.begin:g}{until} s, in which no control step of the run ends; the run ends at "
                f"{ends[-1]:g} s"
            )
        self.rigid, self.over = spec.rigid, spec.over


@plugin("objective", "hold")
class Hold(OfRigid):
    """Squared speed [m^2/s^2] of a rigid body relative to what holds it: how fast it slips; 0 if it is held still.

    With `squared: false` it is the speed itself [m/s], which suits a constraint; its gradient at 0 is taken as 0.

    What holds it is another rigid body (`by`), such as a hand on a path, or the centroid of a soft body or of a group
    of it (`body`), such as a fingertip; without both, the body should be at rest. Speeds are those of centres, without
    spin. For bounds on the force of a finger, add a constraint on the `reaction` of its mount.
    """

    by: RigidName | None = Field(description="Rigid body with which it should move", default=None)
    body: BodyName | None = Field(description="Soft body with whose centroid it should move", default=None)
    group: GroupName | None = Field(description=A_GROUP, default=None)
    squared: bool = Field(description="Whether the speed is squared", default=True)
    over: Over = Field(description="How the values of all control steps are combined", default="mean")

    def bind(self, matter: Matter) -> BoundTerm:
        return Slip(self, matter)


class Slip(CountedForSomeTime):
    """Squared speed of one rigid body relative to another, to a centroid, or to the world."""

    def __init__(self, spec: Hold, matter: Matter) -> None:
        super().__init__(spec, matter)
        if spec.by is not None and spec.body is not None:
            raise UsageError("has `by` and `body`: give one of them")
        if spec.by == spec.rigid:
            raise UsageError(f"'{spec.rigid}' cannot hold itself: give another rigid body as `by`")
        held_by = [] if spec.body is None else [matter.members(spec.body, spec.group)]
        self.rows, self.by, self.soft = means(held_by, matter.n_particles), spec.by, spec.body is not None
        self.squared = spec.squared
        turns = 2 * matter.dim - 3
        self.columns = slice(matter.dim + turns, 2 * matter.dim + turns)

    def steps(self, track: Track) -> Array:
        return np.where(self.counts, lengths(self._slip(track), self.squared), 0.0)

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        slip_bar = lengths_vjp(self._slip(track), self.squared, np.where(self.counts, h_bar, 0.0))
        rigid_bar = {self.rigid: self._columns_bar(track, slip_bar)}
        if self.by is not None:
            rigid_bar[self.by] = -self._columns_bar(track, slip_bar)
        if not self.soft:
            return TrackBar(rigid=rigid_bar)
        v_bar = np.zeros(track.v.shape)
        v_bar[1:, 0] = -slip_bar
        return TrackBar(rigid=rigid_bar, v=v_bar)

    def _slip(self, track: Track) -> Array:
        """Return the relative velocity at the end of every control step (T, D) [m/s]."""
        v = track.rigid[self.rigid][1:, self.columns]
        if self.soft:
            return np.asarray(v - track.v[1:, 0])
        return v if self.by is None else np.asarray(v - track.rigid[self.by][1:, self.columns])

    def _columns_bar(self, track: Track, slip_bar: Array) -> Array:
        bar = np.zeros(track.rigid[self.rigid].shape)
        bar[1:, self.columns] = slip_bar
        return bar


@plugin("objective", "lift")
class Lift(OfRigid, AlongAxis):
    """Squared distance [m^2] by which a rigid body is lower than it should have been lifted; 0 if it is higher."""

    height: float = quantity("m", "How far it should be lifted from its place at the start, along `axis`")

    def bind(self, matter: Matter) -> BoundTerm:
        return Shortfall(self, matter)


class Shortfall(CountedForSomeTime):
    """The square of what lacks to a height."""

    def __init__(self, spec: Lift, matter: Matter) -> None:
        super().__init__(spec, matter)
        self.rows, self.height, self.axis = means([], matter.n_particles), spec.height, spec.index

    def steps(self, track: Track) -> Array:
        return self._lacks(track) ** 2

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        rigid_bar = np.zeros(track.rigid[self.rigid].shape)
        rigid_bar[1:, self.axis] = -2.0 * self._lacks(track) * h_bar
        return TrackBar(rigid={self.rigid: rigid_bar})

    def _lacks(self, track: Track) -> Array:
        """Return how far it is too low at the end of every control step (T,) [m]; 0 where that does not count."""
        gap = self.height - track.rigid[self.rigid][1:, self.axis]
        return np.where(self.counts & (gap.real > 0.0), gap, 0.0)
