"""A place on a body: all of it, a group, a region at rest, or a point of the material."""

from __future__ import annotations

from typing import TYPE_CHECKING, Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import complaint, finding
from cqrun.geometry.region import ChosenRegion
from cqrun.measurements.binding import bind
from cqrun.measures.measure import Measure
from cqrun.observers.matter import A_GROUP, Matter
from cqrun.observers.rows import means, weighted
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.reference import GroupName, OnlyBodyName

if TYPE_CHECKING:
    from scipy.sparse import csr_array

OFF = 1e-3
"""A point is inside the material if the particles around it give it back within this part of their spacing."""


class OnPart(Measure):
    """Base of quantities of a part of a body: all of it, a group, or a region at rest."""

    body: OnlyBodyName = Field(description="Body that is measured; may be omitted if the scene has only one")
    group: GroupName | None = Field(description=A_GROUP, default=None)
    region: ChosenRegion | None = Field(description="Region at rest, instead of a group", default=None)

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        given = [name for name in ("group", "region", "point") if getattr(self, name, None) is not None]
        if len(given) > 1:
            message = f"takes one of {', '.join(given)}, not {'both' if len(given) == 2 else 'all'}: remove the others"
            raise complaint(type(self).__name__, [finding(message, involves=given)])
        return self

    def members(self, matter: Matter) -> Array:
        """Return the indices of the particles; UsageError if there are none."""
        if self.region is not None:
            return matter.within(self.body, self.region)
        return matter.members(self.body, self.group)


class AtPlace(OnPart):
    """Base of quantities of one place on a body, which may also be a point of the material."""

    point: list[float] | None = vector(
        "m", "Point of the material at rest, instead of a group: the particles around it are interpolated", default=None
    )

    def row(self, matter: Matter) -> csr_array:
        """Return the weights of the particles whose sum is the place (1, N)."""
        if self.point is None:
            return means([self.members(matter)], matter.n_particles)
        return point_row(matter, self.body, np.array(self.point))


def point_row(matter: Matter, body: str, point: Array) -> csr_array:
    """Return the weights of a body's particles that interpolate a point of the material (1, N).

    They are exact for affine motions (measurements/binding.py).

    Raises:
        UsageError: the point is not inside the body.
    """
    members, spacing = matter.members(body), matter.spacing[body]
    x = matter.x[members]
    bound = bind(point[None], x, spacing)
    off = float(np.linalg.norm(bound.stems[0]))
    if off > OFF * spacing:
        nearest = x[((x - point) ** 2).sum(axis=1).argmin()]
        where = ", ".join(f"{a:.4g}" for a in nearest)
        gap = float(np.linalg.norm(nearest - point))
        raise UsageError(
            f"the point is not inside the body '{body}': its nearest particle, at [{where}], is {gap:.3g} m away"
        )
    row = bound.rows
    return weighted([members[row.indices]], [row.data], matter.n_particles)
