"""Distance of a body from where it should be."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import complaint, finding
from cqrun.objectives.gaps import lengths, lengths_vjp
from cqrun.objectives.term import BoundTerm, ObjectiveTerm
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.reference import BodyName, GoalName, GroupName, NamesGroup, Position
from cqrun.plugin.registry import plugin


@plugin("objective", "reach")
class Reach(ObjectiveTerm):
    """Squared distance [m^2] of a centroid (plain mean) from a goal, a fixed position, or another body's centroid.

    With `squared: false` it is the distance itself [m]; its gradient at 0 is taken as 0.
    """

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body that reaches")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    goal: GoalName | None = Field(description="Name of the goal", default=None)
    position: Position | None = vector("m", "Position where it should be", default=None)
    target: BodyName | None = Field(description="Body whose centroid it should reach", default=None)
    target_group: Annotated[str, NamesGroup(of="target")] | None = Field(
        description="Group of that body; the whole body if absent", default=None
    )
    squared: bool = Field(description="Whether the distance is squared", default=True)

    @model_validator(mode="after")
    def _one_target(self) -> Self:
        targets = [name for name in ("goal", "position", "target") if getattr(self, name) is not None]
        if len(targets) != 1:
            message = f"needs exactly one of goal, position, target; has {', '.join(targets) or 'none'}"
            raise complaint("Reach", [finding(message, involves=targets)])
        if self.target_group is not None and self.target is None:
            raise complaint("Reach", [finding("has no meaning without a target", ("target_group",))])
        return self

    def bind(self, matter: Matter) -> BoundTerm:
        if self.goal is not None and (size := matter.goal_size(self.goal)) != matter.dim:
            raise UsageError(f"the goal '{self.goal}' has {size} entries; a position here has {matter.dim}")
        return AimGap(self, matter)


class AimGap(BoundTerm):
    """Gap between a centroid and its target: a goal, a point, or the second row's centroid."""

    def __init__(self, spec: Reach, matter: Matter) -> None:
        sets = [matter.members(spec.body, spec.group)]
        if spec.target is not None:
            sets.append(matter.members(spec.target, spec.target_group))
        self.rows = means(sets, matter.n_particles)
        self.over, self.squared, self.goal = spec.over, spec.squared, spec.goal
        self.position = np.zeros(matter.dim) if spec.position is None else np.array(spec.position)
        self.course = None if spec.position is None else self.position[None]

    def steps(self, track: Track) -> Array:
        return lengths(self._gap(track), self.squared)

    def steps_vjp(self, track: Track, h_bar: Array) -> TrackBar:
        gap_bar = lengths_vjp(self._gap(track), self.squared, h_bar)
        x_bar = np.zeros(track.x.shape)
        x_bar[1:, 0] = gap_bar
        x_bar[1:, 1:] = -gap_bar[:, None]
        return TrackBar(x=x_bar)

    def _gap(self, track: Track) -> Array:
        """Return the centroid minus its target (T, D) [m]."""
        if track.x.shape[1] == 2:
            return np.asarray(track.x[1:, 0] - track.x[1:, 1])
        return np.asarray(track.x[1:, 0] - (self.position if self.goal is None else track.goals[self.goal]))
