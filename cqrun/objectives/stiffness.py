"""Stiffness of a body."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from cqrun.objectives.design import STIFFNESS, DesignSum
from cqrun.objectives.term import BoundTerm, ObjectiveTerm
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("objective", "stiffness")
class Stiffness(ObjectiveTerm):
    """Young's modulus [Pa], the plain mean over a body's particles."""

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body whose stiffness is measured")
    group: GroupName | None = Field(description=A_GROUP, default=None)

    def bind(self, matter: Matter) -> BoundTerm:
        members = matter.members(self.body, self.group)
        return DesignSum(matter, self.over, STIFFNESS, members, 1.0 / len(members))
