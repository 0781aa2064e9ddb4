"""Loads: they add mass, damping or force to particles, linearly in their own parameters.

`apply` changes `ParticleFields` in place. `apply_vjp`, its adjoint, adds to the cotangents of the fields that `apply`
reads and returns the cotangents of the load's own differentiable fields. Loads are applied in this order: attached
masses, damping, point forces, then gravity, which acts on all mass; the adjoints run in reverse.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import Field

from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin
from cqrun.plugin.reference import BodyName
from cqrun.state import ParticleFields


class Load(Plugin):
    """A load on the particles of a body, or of all bodies, that lie in a region at rest, or on all of them."""

    order: ClassVar[int] = 0
    body: BodyName | None = Field(description="Body that it acts on; all bodies if absent", default=None)
    region: Annotated[Chosen[Plugin], Choice("region")] | None = Field(
        description="Region at rest; everywhere if absent", default=None
    )

    def apply(self, fields: ParticleFields, chosen: Array) -> None:
        """Add this load to the particles `chosen` (indices)."""
        raise NotImplementedError

    def apply_vjp(self, fields: ParticleFields, fields_bar: ParticleFields, chosen: Array) -> dict[str, Any]:
        """Return the cotangents of this load's fields."""
        raise NotImplementedError
