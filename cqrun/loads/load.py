"""What a load is: something that adds mass, damping or force to particles, linearly in its own parameters.

`apply` changes `ParticleFields` in place; `apply_vjp` is its adjoint: it adds to the cotangents of the fields
it read and returns the cotangents of its own differentiable fields. Loads are applied in the order: attached
masses, damping, point forces, then gravity, which acts on all mass; adjoints in reverse.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import Field

from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array, Plugin
from cqrun.plugin.reference import BodyName
from cqrun.state import ParticleFields


class Load(Plugin):
    """A load on the particles of a body, or of all, inside a region at rest, or everywhere."""

    order: ClassVar[int] = 0
    body: BodyName | None = Field(description="Body it acts on; all if absent", default=None)
    region: Annotated[Chosen[Plugin], Choice("region")] | None = Field(
        description="Where, at rest; everywhere if absent", default=None
    )

    def apply(self, fields: ParticleFields, chosen: Array) -> None:
        """Add this load to the particles `chosen` (indices)."""
        raise NotImplementedError

    def apply_vjp(self, fields: ParticleFields, fields_bar: ParticleFields, chosen: Array) -> dict[str, Any]:
        """Return the cotangents of this load's fields."""
        raise NotImplementedError
