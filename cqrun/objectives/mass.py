"""Mass of a body."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from cqrun.objectives.design import MASS, DesignSum
from cqrun.objectives.term import BoundTerm, ObjectiveTerm
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("objective", "mass")
class Mass(ObjectiveTerm):
    """Mass [kg] (2D: [kg/m]) of a body, with masses that are attached to it."""

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body whose mass is measured")
    group: GroupName | None = Field(description=A_GROUP, default=None)

    def bind(self, matter: Matter) -> BoundTerm:
        return DesignSum(matter, self.over, MASS, matter.members(self.body, self.group))
