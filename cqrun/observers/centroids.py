"""Centroids of a body's groups."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cqrun.observers.matter import Matter
from cqrun.observers.motion import Motion, MotionObserver
from cqrun.plugin.reference import GroupName
from cqrun.plugin.registry import plugin


@plugin("observer", "centroids")
class Centroids(MotionObserver):
    """Position [m], velocity [m/s] and acceleration [m/s^2] of the centroids of a body's groups.

    A centroid is the plain mean over the group's particles, as in both papers. The acceleration is the change of
    velocity since the last control step, divided by that step. It is zero at the first control step.
    """

    groups: list[GroupName] | Literal["all"] = Field(
        description="Names of groups or of the scene's regions; all: every group in order, or the body if it has none",
        default="all",
    )

    def bind(self, matter: Matter) -> Motion:
        names = list(matter.groups.get(self.body, {})) if self.groups == "all" else self.groups
        pieces = [matter.members(self.body, name) for name in names] or [matter.members(self.body)]
        return self.motion(pieces, matter)
