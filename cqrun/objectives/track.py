"""Distance of a body from where it should be at each time."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import Loc, complaint, finding, listed
from cqrun.objectives.gaps import lengths, lengths_vjp
from cqrun.objectives.hermite import Interpolant, interpolant
from cqrun.objectives.recorded import RecordedPath
from cqrun.objectives.term import BoundTerm, ObjectiveTerm, Over
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.reference import BodyName, GroupName, InWorld
from cqrun.plugin.registry import plugin

Point = Annotated[list[float], Field(min_length=3, max_length=4), InWorld(first=1)]
_UNIT = "s, m"
COURSES = ("path", "keys", "marker")


@plugin("objective", "track")
class Tracking(ObjectiveTerm):
    """Squared distance [m^2] of a centroid (plain mean) from a path, or from key frames at their times.

    A `path` is interpolated linearly between its points, and constant before the first and after the last. It is
    compared at every control step, and so is the path of a recorded `marker`. `keys` are compared at their own times
    only, with cubic Hermite interpolation between control steps; their `sum` is multiplied by the control step. With
    `squared: false` it is the distance itself [m].
    """

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body that follows")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    path: list[Point] | None = quantity(_UNIT, "Points [t, x, y(, z)] of a path", min_length=1, default=None)
    keys: list[Point] | None = quantity(_UNIT, "Key frames [t, x, y(, z)]", min_length=1, default=None)
    marker: RecordedPath | None = Field(description="Recorded marker to follow", default=None)
    squared: bool = Field(description="Whether the distance is squared", default=True)
    over: Over = Field(description="How the values of all control steps, or keys, are combined", default="mean")

    @model_validator(mode="after")
    def _one_course(self) -> Self:
        present = [name for name in COURSES if getattr(self, name) is not None]
        if len(present) != 1:
            message = f"needs exactly one of {listed(COURSES)}; has {listed(present)}"
            raise complaint("Tracking", [finding(message, involves=tuple(present[1:]))])
        for name, points in (("path", self.path), ("keys", self.keys)):
            times = np.array([point[0] for point in points or []])
            if np.any(np.diff(times) <= 0) or np.any(times < 0):
                message = "must have times that begin at 0 or later and increase from point to point"
                raise complaint("Tracking", [finding(message, (name,))])
        return self

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        problems = super().dim_problems(dim)
        for name in ("path", "keys"):
            for k, point in enumerate(getattr(self, name) or []):
                if len(point) != dim + 1:
                    message = f"must have {dim + 1} entries in this {dim}D world, time first, has {len(point)}"
                    problems.append(((name, k), message))
        return problems

    def bind(self, matter: Matter) -> BoundTerm:
        members = matter.members(self.body, self.group)
        targets, keys = self._targets(matter, members)
        bound = TrackingGap(targets, keys)
        bound.rows, bound.over, bound.squared = means([members], matter.n_particles), self.over, self.squared
        return bound

    def _targets(self, matter: Matter, members: Array) -> tuple[Array, Interpolant | None]:
        """Return the target positions (T or number of keys, D) [m], and the interpolant at the times of keys."""
        if self.marker is not None:
            return self.marker.course(matter, matter.x[members].mean(axis=0)), None
        course = np.array(self.path if self.path is not None else self.keys)
        times, points = course[:, 0], course[:, 1:]
        if self.path is not None:
            if times[0] > matter.duration * (1 + 1e-9):
                raise UsageError(
                    f"the path begins at {times[0]:g} s, after the end of the run at {matter.duration:g} s: it is in s"
                )
            ends = matter.control_step * np.arange(1, matter.n_controls + 1)
            return np.stack([np.interp(ends, times, column) for column in points.T], axis=1), None
        if times[-1] > matter.duration * (1 + 1e-9):
            raise UsageError(f"a key frame at {times[-1]:g} s is after the end of the run at {matter.duration:g} s")
        return points, interpolant(times, matter.control_step, matter.n_controls)


class TrackingGap(BoundTerm):
    """Gap between a centroid and its target, at every control step or at the times of `keys`."""

    squared: bool

    def __init__(self, targets: Array, keys: Interpolant | None) -> None:
        self.targets = self.course = targets
        self.keys = keys

    def steps(self, track: Track) -> Array:
        return lengths(self._gap(track), self.squared)

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        gap_bar = lengths_vjp(self._gap(track), self.squared, h_bar)
        if self.keys is not None:
            x_bar, v_bar = self.keys.vjp(gap_bar[:, None])
            return TrackBar(x=x_bar, v=v_bar)
        x_bar = np.zeros(track.x.shape)
        x_bar[1:, 0] = gap_bar
        return TrackBar(x=x_bar)

    def _gap(self, track: Track) -> Array:
        """Return the centroid minus its target (T or number of keys, D) [m]."""
        at = track.x[1:, 0] if self.keys is None else self.keys(track.x, track.v)[:, 0]
        return np.asarray(at - self.targets)
