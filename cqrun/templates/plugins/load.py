"""A load of your own: a steady force on particles. Here it gives the particles of a region an acceleration.

`apply` adds to the force, the mass or the damping of particles. `apply_vjp` is its adjoint, and
`cqrun gradcheck my_load.yaml --allow-plugins` checks that the two agree.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from cqrun.loads.load import Load
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.registry import plugin
from cqrun.state import ParticleFields


@plugin("load", "my_load")
class MyLoad(Load):
    """An acceleration of the particles of a region, as a force of mass times acceleration.

    This text is the page of the load: `cqrun describe load my_load --plugin my_load.py`.
    """

    order: ClassVar[int] = 3  # loads that add mass come first, so that this one acts on all mass
    acceleration: list[float] = vector("m/s^2", "Acceleration", differentiable=True)

    def apply(self, fields: ParticleFields, chosen: Array) -> None:
        """Add this load to the particles `chosen` (indices)."""
        fields.force[chosen] += fields.mass[chosen, None] * np.array(self.acceleration)

    def apply_vjp(self, fields: ParticleFields, fields_bar: ParticleFields, chosen: Array) -> dict[str, Any]:
        """Return the cotangents of this load's fields; add those of what `apply` reads to `fields_bar`."""
        force_bar = fields_bar.force[chosen]
        fields_bar.mass[chosen] += force_bar @ np.array(self.acceleration)
        return {"acceleration": fields.mass[chosen] @ force_bar}
