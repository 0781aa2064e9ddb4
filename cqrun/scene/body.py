"""What a scene says of a body: its shape or parts, where it lies, its particles and material."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from cqrun.explain import Loc, complaint, finding
from cqrun.geometry.lattice import Lattice
from cqrun.geometry.place import Place
from cqrun.geometry.region import ChosenRegion
from cqrun.geometry.sampling import ChosenSampling
from cqrun.geometry.shape import ChosenShape, Shape
from cqrun.geometry.transformed import Transformed
from cqrun.geometry.union import Union
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Spec, quantity, vector
from cqrun.plugin.reference import FilledIn, NamesRegion
from cqrun.scene.data import exactly_one
from cqrun.scene.fields import Name
from cqrun.scene.material import Material, OtherMaterial


class Body(Spec):
    """One elastic body: a shape, or named parts, filled with particles of one material."""

    shape: ChosenShape | None = Field(description="Where the body is at the start; or give parts", default=None)
    parts: dict[Name, ChosenShape] | None = Field(
        description="Name -> shape; each is filled on its own, and is a group", min_length=1, default=None
    )
    place: Place | None = Field(
        description="Where the coordinates of shape, parts and groups lie in the world; they are the world's if absent",
        default=None,
    )
    particles_per_cell: float | None = quantity("1", "Particles in a cell: spacing = dx / n^(1/D)", gt=0, default=None)
    spacing: float | None = quantity("m", "Distance between particles", gt=0, default=None)
    sampling: ChosenSampling = Field(
        description="How particles are placed", default_factory=lambda: Chosen("lattice", Lattice())
    )
    velocity: Annotated[list[float], FilledIn("zero vector")] = vector(
        "m/s", "Velocity at the start; zero if absent", differentiable=True
    )
    spin: Annotated[list[float], FilledIn("zero spin")] = quantity(
        "rad/s",
        "Rate of rotation about the centroid at the start (2D: one entry); zero if absent",
        differentiable=True, min_length=1, max_length=3,
    )  # fmt: skip
    unit_mass: bool = Field(description="Every particle has mass = density and volume 1", default=False)
    groups: dict[Name, ChosenRegion] = Field(description="Named regions of the body", default_factory=dict)
    material: Material = Field(description="What it is made of")
    material_of: dict[Annotated[Name, NamesRegion()], OtherMaterial] = Field(
        description="Name of a group or region -> what is different there; a later one wins", default_factory=dict
    )

    @model_validator(mode="after")
    def _one_of_each(self) -> Self:
        exactly_one(self, ("shape", "parts"))
        if self.sampling.value.needs_spacing:
            exactly_one(self, ("particles_per_cell", "spacing"))
        elif self.particles_per_cell is not None or self.spacing is not None:
            name = "spacing" if self.particles_per_cell is None else "particles_per_cell"
            message = f"has no meaning with {self.sampling.name} sampling, which has a count: remove it"
            raise complaint("Body", [finding(message, (name,), involves=("sampling",))])
        return self

    @model_validator(mode="after")
    def _one_law(self) -> Self:
        found = [
            finding(message, ("material_of", name, *place))
            for name, other in self.material_of.items()
            for place, message in other.problems(self.material)
        ]
        if found:
            raise complaint("Body", found)
        return self

    @property
    def pieces(self) -> dict[str, Shape]:
        """The shapes that are filled on their own, in the body's coordinates, by their key path inside the body."""
        if self.shape is not None:
            return {"shape": self.shape.value}
        return {f"parts.{name}": chosen.value for name, chosen in (self.parts or {}).items()}

    @property
    def group_names(self) -> tuple[str, ...]:
        """The names of all groups, in the order in which values `per: group` are given."""
        return (*(self.parts or {}), *self.colours, *self.groups)

    @property
    def colours(self) -> tuple[str, ...]:
        """The names of the colours of its images, each a group."""
        return tuple(dict.fromkeys(name for piece in self.pieces.values() for name in piece.colour_names))

    def whole(self) -> Shape:
        """Return the body as one shape in the world."""
        whole = self.shape or Chosen("union", Union(shapes=list((self.parts or {}).values())))
        return whole.value if self.place is None else Transformed(shape=whole, **dict(self.place))

    def particle_spacing(self, dx: float) -> float | None:
        """Return the distance between particles [m] on a grid of edge dx [m]; None with a count of them."""
        if self.particles_per_cell is not None:
            return dx / self.particles_per_cell ** (1 / len(self.velocity))
        return self.spacing

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        found, wanted = super().dim_problems(dim), 1 if dim == 2 else 3
        if len(self.spin) != wanted:
            message = f"must have {wanted} entries in this {dim}D world, has {len(self.spin)}"
            found.append((("spin",), message))
        return found
