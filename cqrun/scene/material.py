"""A body's material: a density, an elastic law, and further terms by their plug-ins' names."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import InitErrorDetails

from cqrun.explain import KEY, Loc, complaint, finding, listed, reworded, suggest
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Plugin, Spec, quantity
from cqrun.plugin.registry import plugins

TERMS = "material_term"
"""Kind of the plug-ins whose names are keys of a material."""

TERMS_MARK = "x-cqrun-terms"
"""JSON schema key that says that plug-ins of a kind are properties here."""


class Terms(Spec):
    """Something whose further keys are the names of material terms, such as `viscosity`."""

    model_config = ConfigDict(extra="allow", json_schema_extra={TERMS_MARK: TERMS})

    @property
    def terms(self) -> dict[str, Plugin]:
        """The further terms by name, in alphabetical order."""
        return dict(sorted((self.model_extra or {}).items()))

    @model_validator(mode="wrap")
    @classmethod
    def _with_terms(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(data, dict):
            return handler(data)
        findings: list[InitErrorDetails] = []
        built = {k: v if k in cls.model_fields else _term(k, v, cls, findings) for k, v in data.items()}
        try:
            material = handler(built)
        except ValidationError as error:
            findings += [reworded(e) for e in error.errors(include_url=False)]
        if findings:
            raise complaint(cls.__name__, findings)
        return material


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


def _term(name: str, value: Any, cls: type[Terms], findings: list[InitErrorDetails]) -> Plugin | None:
    """Return the validated term, or add to the findings."""
    legal = plugins(TERMS)
    if name not in legal:
        keys = [*cls.model_fields, *legal]
        message = f"unknown key{suggest(name, keys)}; keys here: {listed(keys)}"
        findings.append(finding(message, (name,), kind=KEY))
        return None
    try:
        term: Plugin = legal[name].model_validate(value)
    except ValidationError as error:
        findings += [reworded(e, (name,)) for e in error.errors(include_url=False)]
        return None
    return term
