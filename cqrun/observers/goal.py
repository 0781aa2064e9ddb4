"""Position of a goal relative to a body."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.ranges import Range, limits
from cqrun.observers.rows import means
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import BodyName, GoalName, GroupName
from cqrun.plugin.registry import plugin


@plugin("observer", "goal")
class Goal(Observer):
    """A goal's position minus the centroid (plain mean) of a body or of one of its groups; or the goal itself."""

    goal: GoalName = Field(description="Name of the goal, a position")
    body: BodyName | None = Field(description="Body whose centroid is subtracted; if absent, none is", default=None)
    group: GroupName | None = Field(description=A_GROUP, default=None)
    range: Range = Field(
        description="[low, high] in m that is scaled to [-1, 1], or one pair for each axis; auto: the world's size; "
        "null: values as they are",
        default="auto",
    )

    def bind(self, matter: Matter) -> BoundObserver:
        size = matter.goal_size(self.goal)
        if size != matter.dim:
            raise UsageError(f"the goal '{self.goal}' has {size} entries; a position here has {matter.dim}")
        if self.group is not None and self.body is None:
            raise UsageError(f"the group '{self.group}' needs its body: add `body`")
        return GoalOffset(self, matter)


class GoalOffset(BoundObserver):
    """Goal minus centroid."""

    def __init__(self, spec: Goal, matter: Matter) -> None:
        self.goal, self.size, self.relative = spec.goal, matter.dim, spec.body is not None
        sets = [matter.members(spec.body, spec.group)] if spec.body is not None else []
        self.rows = means(sets, matter.n_particles)
        low = -matter.size if self.relative else 0.0 * matter.size
        self.low, self.high = limits(spec.range, low, 1.0 * matter.size)

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        goal = moment.goals[self.goal]
        return goal - moment.x[0] if self.relative else goal, np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        return MomentBar(x=-z_bar[None]) if self.relative else MomentBar()
