"""A body's material: a density, an elastic law, and further terms by their plug-ins' names."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar

from pydantic import Field

from cqrun.explain import Loc
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Plugin, quantity
from cqrun.scene.plugin_keys import PluginKeys

TERMS = "material_term"
"""Kind of the plug-ins whose names are keys of a material."""


class Terms(PluginKeys):
    """Something whose further keys are the names of material terms, such as `viscosity`."""

    keys_of: ClassVar[str] = TERMS

    @property
    def terms(self) -> dict[str, Plugin]:
        """The further terms by name, in alphabetical order."""
        return self.chosen


class Material(Terms):
    """A sum of terms: `elastic` is chosen; every other key is the name of a term, such as `viscosity`."""

    density: float = quantity("kg/m^3", "Density at rest", differentiable=True, gt=0)
    elastic: Annotated[Chosen[Plugin], Choice("elastic")] = Field(description="Elastic law")


class OtherMaterial(Terms):
    """A body's material in one of its regions: density, and terms with all their values; what is not named stays."""

    density: float | None = quantity("kg/m^3", "Density at rest", differentiable=True, gt=0, default=None)
    elastic: Annotated[Chosen[Plugin], Choice("elastic")] | None = Field(
        description="The body's elastic law, with other values", default=None
    )

    def problems(self, material: Material) -> Iterator[tuple[Loc, str]]:
        """Yield what cannot differ from a body's material inside one body, with its place."""
        own, other = material.elastic, self.elastic
        if other is not None and other.name != own.name:
            yield ("elastic",), f"is another law than the body's {own.name}: make this region a body of its own"
        elif other is not None:
            yield from _fixed(("elastic", own.name), own.value, other.value)
        for name, term in self.terms.items():
            if name not in material.terms:
                message = "is no term of the body's material: give it to the whole body, with values of no effect"
                yield (name,), message
            else:
                yield from _fixed((name,), material.terms[name], term)

    def value(self, suffix: str) -> float | None:
        """Return the value of a path inside a material, such as `viscosity.shear`; None where it stays."""
        *place, name = suffix.split(".")
        node: Any = self if not place else self.terms.get(place[0])
        if place and place[0] == "elastic":
            node = self.elastic.value if self.elastic is not None else None
        return getattr(node, name, None)


def _fixed(place: Loc, own: Any, other: Any) -> Iterator[tuple[Loc, str]]:
    """Yield what a region cannot have of its own: what is no parameter of its term, one a particle."""
    for name in type(own).model_fields:
        if name not in own.parameters and getattr(own, name) != getattr(other, name):
            message = f"must be {getattr(own, name)} as in the whole body, is {getattr(other, name)}"
            yield (*place, name), f"{message}; with another make this region a body of its own"
