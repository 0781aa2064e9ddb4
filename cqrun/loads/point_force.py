"""A dead load: a force of constant size and direction, spread evenly over the particles of a region."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from cqrun.loads.load import Load
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.registry import plugin
from cqrun.state import ParticleFields


@plugin("load", "point_force")
class PointForce(Load):
    """A constant force, spread evenly over the n particles of a region: f_p += force / n."""

    order: ClassVar[int] = 2
    force: list[float] = vector("N", "Total force; in 2D per metre of depth", differentiable=True)

    def apply(self, fields: ParticleFields, chosen: Array) -> None:
        fields.force[chosen] += np.array(self.force) / len(chosen)

    def apply_vjp(self, fields: ParticleFields, fields_bar: ParticleFields, chosen: Array) -> dict[str, Any]:
        return {"force": fields_bar.force[chosen].sum(axis=0) / len(chosen)}
