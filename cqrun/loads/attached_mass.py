"""A mass attached to particles: it moves with them and feels gravity, but adds no stiffness."""

from __future__ import annotations

from typing import Any

from cqrun.loads.load import Load
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin
from cqrun.state import ParticleFields


@plugin("load", "attached_mass")
class AttachedMass(Load):
    """A mass spread evenly over the n particles of a region: m_p += mass / n."""

    mass: float = quantity("kg", "Total attached mass; in 2D per metre of depth", differentiable=True, ge=0)

    def apply(self, fields: ParticleFields, chosen: Array) -> None:
        fields.mass[chosen] += self.mass / len(chosen)

    def apply_vjp(self, fields: ParticleFields, fields_bar: ParticleFields, chosen: Array) -> dict[str, Any]:
        return {"mass": float(fields_bar.mass[chosen].sum()) / len(chosen)}
