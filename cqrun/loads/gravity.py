"""Gravity: f_p = m_p g. A scene sets it with `world.gravity`; it also acts on attached masses."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from cqrun.loads.load import Load
from cqrun.plugin.contract import Array, vector
from cqrun.state import ParticleFields


class Gravity(Load):
    """Gravity on all particles, f_p = m_p g."""

    order: ClassVar[int] = 3
    gravity: list[float] = vector("m/s^2", "Gravity", differentiable=True)

    def apply(self, fields: ParticleFields, chosen: Array) -> None:
        fields.force[chosen] += fields.mass[chosen, None] * np.array(self.gravity)

    def apply_vjp(self, fields: ParticleFields, fields_bar: ParticleFields, chosen: Array) -> dict[str, Any]:
        force_bar = fields_bar.force[chosen]
        fields_bar.mass[chosen] += force_bar @ np.array(self.gravity)
        return {"gravity": fields.mass[chosen] @ force_bar}
