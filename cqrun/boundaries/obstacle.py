"""Base of boundaries that bodies may leave: obstacles, which bodies of the reference frame touch."""

from __future__ import annotations

from typing import ClassVar

from cqrun.boundaries.condition import BoundaryCondition
from cqrun.errors import UnknownDistance, UsageError
from cqrun.plugin.contract import quantity


class Obstacle(BoundaryCondition):
    """A boundary that bodies may leave.

    In the updated frame it is a condition on grid nodes. In the reference frame it is a solid with a surface of its
    own: bodies touch the faces of the world, half-spaces, height fields, boxes, balls, capsules, cylinders, cones,
    polygons, closed meshes and unions of them. `normal` then has no use.
    """

    is_obstacle: ClassVar[bool] = True

    dashpot: float = quantity(
        "1", "Reference frame: damping of contact along the normal, as a part of the material's wave impedance",
        ge=0, default=0.1,
    )  # fmt: skip

    @property
    def lacks_normal(self) -> bool:
        """Whether no frame knows its normal: it has none, and nor has its region."""
        return super().lacks_normal and not self.has_surface

    @property
    def has_surface(self) -> bool:
        """Whether the distance from its surface is known, so that bodies of the reference frame can touch it.

        What is wrong with a file is said when the scene is built.
        """
        if self.region is None:
            return True
        try:
            return bool(self.region.value.solids())
        except UnknownDistance:
            return False
        except UsageError:
            return True

    @property
    def only_touched(self) -> bool:
        """Whether it can only be touched: no normal tells the updated frame how it holds nodes."""
        return super().lacks_normal
