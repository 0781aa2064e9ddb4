"""Mass-proportional damping: a drag force - rate m v, like that of air; v decays as exp(-rate t)."""

from __future__ import annotations

from typing import Any, ClassVar

from cqrun.loads.load import Load
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin
from cqrun.state import ParticleFields


@plugin("load", "damping")
class Damping(Load):
    """Mass-proportional damping, force = - rate m v."""

    order: ClassVar[int] = 1
    rate: float = quantity("1/s", "Damping rate", differentiable=True, ge=0)

    def apply(self, fields: ParticleFields, chosen: Array) -> None:
        fields.damping[chosen] += self.rate

    def apply_vjp(self, fields: ParticleFields, fields_bar: ParticleFields, chosen: Array) -> dict[str, Any]:
        return {"rate": float(fields_bar.damping[chosen].sum())}
