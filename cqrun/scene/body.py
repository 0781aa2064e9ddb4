"""Section `bodies`: the shape or parts of a body, its place, its particles and its material."""

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
from cqrun.scene.material import Material, RegionMaterial


class Body(Spec):
    """One elastic body: a shape, or named parts, filled with particles of one material."""

    shape: ChosenShape | None = Field(description="Shape of the body at the start; give this or parts", default=None)
    parts: dict[Name, ChosenShape] | None = Field(
        description="Name -> shape; each is filled separately and is a group", min_length=1, default=None
    )
    place: Place | None = Field(
        description="Place of the body's coordinates (of shape, parts and groups) in the world; world coordinates if "
        "absent",
        default=None,
    )
    particles_per_cell: float | None = quantity("1", "Particles per cell: spacing = dx / n^(1/D)", gt=0, default=None)
    spacing: float | None = quantity("m", "Distance between particles", gt=0, default=None)
    sampling: ChosenSampling = Field(
        description="Placement of the particles", default_factory=lambda: Chosen("lattice", Lattice())
    )
    velocity: Annotated[list[float], FilledIn("zero vector")] = vector(
        "m/s", "Velocity at the start; zero if absent", differentiable=True
    )
    spin: Annotated[list[float], FilledIn("zero spin")] = quantity(
        "rad/s",
        "Angular velocity about the centroid at the start (2D: one entry); zero if absent",
        differentiable=True, min_length=1, max_length=3,
    )  # fmt: skip
    unit_mass: bool = Field(description="Every particle has mass = density and volume 1", default=False)
    groups: dict[Name, ChosenRegion] = Field(description="Named regions of the body", default_factory=dict)
    material: Material = Field(description="Material of the body")
    material_of: dict[Annotated[Name, NamesRegion()], RegionMaterial] = Field(
        description="Name of a group or region -> values that differ there; a later entry overrides an earlier one",
        default_factory=dict,
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
        findings = [
            finding(message, ("material_of", name, *place))
            for name, other in self.material_of.items()
            for place, message in other.problems(self.material)
        ]
        if findings:
            raise complaint("Body", findings)
        return self

    @property
    def pieces(self) -> dict[str, Shape]:
        """The shapes that are filled separately, in the body's coordinates, by their key path inside the body."""
        if self.shape is not None:
            return {"shape": self.shape.value}
        return {f"parts.{name}": chosen.value for name, chosen in (self.parts or {}).items()}

    @property
    def materials(self) -> dict[str, Material | RegionMaterial]:
        """The material of the body and those of its regions, by their key path inside the body."""
        return {"material": self.material, **{f"material_of.{name}": own for name, own in self.material_of.items()}}

    @property
    def group_names(self) -> tuple[str, ...]:
        """The names of all groups, in the order of the values of an unknown with `per: group`."""
        return (*(self.parts or {}), *self.colours, *self.groups)

    @property
    def colours(self) -> tuple[str, ...]:
        """The names of the colours in its images; each colour is a group."""
        return tuple(dict.fromkeys(name for piece in self.pieces.values() for name in piece.colour_names))

    def whole(self) -> Shape:
        """Return the whole body as one shape in the world."""
        whole = self.shape or Chosen("union", Union(shapes=list((self.parts or {}).values())))
        return whole.value if self.place is None else Transformed(shape=whole, **dict(self.place))

    def particle_spacing(self, dx: float) -> float | None:
        """Return the distance between particles [m] for a grid spacing dx [m]; None if the body gives a count."""
        if self.particles_per_cell is not None:
            return dx / self.particles_per_cell ** (1 / len(self.velocity))
        return self.spacing

    def lattice_spacing(self, dx: float) -> float | None:
        """Return the distance between particles [m] if all are on one lattice; None if not. Each part has its own."""
        one = self.parts is None and self.sampling.value.is_lattice
        return self.particle_spacing(dx) if one else None

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        problems, n_rates = super().dim_problems(dim), 1 if dim == 2 else 3
        if len(self.spin) != n_rates:
            message = f"must have {n_rates} entries in this {dim}D world, has {len(self.spin)}"
            problems.append((("spin",), message))
        return problems
