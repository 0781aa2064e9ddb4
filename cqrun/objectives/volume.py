"""Volume of a body at rest."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from cqrun.objectives.design import VOLUME, DesignSum
from cqrun.objectives.term import BoundTerm, ObjectiveTerm
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.plugin.reference import BodyName, GroupName
from cqrun.plugin.registry import plugin


@plugin("objective", "volume")
class Volume(ObjectiveTerm):
    """Volume [m^3] (2D: area [m^2]) of a body at rest."""

    least: ClassVar[float] = 0.0

    body: BodyName = Field(description="Body whose volume is measured")
    group: GroupName | None = Field(description=A_GROUP, default=None)

    def bind(self, matter: Matter) -> BoundTerm:
        return DesignSum(matter, self.over, VOLUME, matter.members(self.body, self.group))
