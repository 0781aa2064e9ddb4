"""The material of a body: a density, an elastic law, and further terms by the names of their plug-ins."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Self

from pydantic import Field, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from cqrun.explain import Loc
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Plugin, quantity
from cqrun.scene.plugin_keys import PluginKeys

TERMS = "material_term"
"""The kind of plug-ins whose names are keys of a material."""


class Terms(PluginKeys):
    """A part whose further keys are the names of material terms, such as `viscosity`."""

    keys_of: ClassVar[str] = TERMS

    @property
    def terms(self) -> dict[str, Plugin]:
        """The further terms by name, in alphabetical order."""
        return self.chosen


FROM_ELSEWHERE: dict[str, Any] = {
    "card": {"type": "string", "description": "Name of a card of cqrun (cqrun material --list), in place of `elastic`"},
    "file": {"type": "string", "description": "File of `cqrun material` (material.yaml), in place of `elastic`"},
    "poissons_ratio": {"type": "number", "description": "Poisson's ratio of the law of a card or file [1]"},
    "bulk_modulus": {"type": "number", "description": "Bulk modulus of the law of a card or file [Pa]"},
}
"""Keys that fragments.py replaces before a scene is validated, for the JSON schema."""


class Material(Terms):
    """A sum of terms: `elastic` is required; every other key is the name of a term, such as `viscosity`.

    `card: ecoflex_00_30` (`cqrun material --list`) or `file: material.yaml` (written by `cqrun material`) gives the law
    and what else the card or the file has. Keys beside it override it, also `poissons_ratio` and `bulk_modulus`.
    """

    density: float = quantity("kg/m^3", "Density at rest", differentiable=True, gt=0)
    elastic: Annotated[Chosen[Plugin], Choice("elastic")] = Field(description="Elastic law")

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        found = super().__get_pydantic_json_schema__(schema, handler)
        needed = [{"required": ["density", "elastic"]}, {"required": ["card"]}, {"required": ["file"]}]
        own = {k: v for k, v in found.items() if k != "required"}
        return own | {"properties": {**found["properties"], **FROM_ELSEWHERE}, "anyOf": needed}

    @model_validator(mode="after")
    def _bind_terms(self) -> Self:
        for term in self.terms.values():
            term.bind(self.elastic.value)  # type: ignore[attr-defined]  # a term, by its kind
        return self


class RegionMaterial(Terms):
    """The material in one region of a body: a density, and terms with all their values.

    Values that are not given are those of the body.
    """

    density: float | None = quantity("kg/m^3", "Density at rest", differentiable=True, gt=0, default=None)
    elastic: Annotated[Chosen[Plugin], Choice("elastic")] | None = Field(
        description="The body's elastic law, with other values", default=None
    )

    def problems(self, material: Material) -> Iterator[tuple[Loc, str]]:
        """Yield (place, message) for each part that must not differ from the material of the body."""
        law, here = material.elastic, self.elastic
        if here is not None and here.name != law.name:
            yield ("elastic",), f"is another law than the body's {law.name}: make this region a separate body"
        elif here is not None:
            yield from _fixed(("elastic", law.name), law.value, here.value)
        for name, term in self.terms.items():
            if name not in material.terms:
                message = (
                    "is not a term of the body's material: give it to the whole body, with values that have no effect"
                )
                yield (name,), message
            else:
                yield from _fixed((name,), material.terms[name], term)

    def value(self, suffix: str) -> float | None:
        """Return the value of a path inside a material, such as `viscosity.shear`; None if it is not given."""
        *place, name = suffix.split(".")
        node: Any = self if not place else self.terms.get(place[0])
        if place and place[0] == "elastic":
            node = self.elastic.value if self.elastic is not None else None
        return getattr(node, name, None)


def _fixed(place: Loc, whole: Any, here: Any) -> Iterator[tuple[Loc, str]]:
    """Yield (place, message) for fields of a term that differ in a region, but are no parameters per particle."""
    for name in type(whole).model_fields:
        if name not in whole.parameters and getattr(whole, name) != getattr(here, name):
            message = f"must be {getattr(whole, name)} as in the whole body, is {getattr(here, name)}"
            yield (*place, name), f"{message}; for another value make this region a separate body"
