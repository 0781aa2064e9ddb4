"""A body's material: a density, an elastic law, and further terms by their plug-ins' names."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic_core import InitErrorDetails

from cqrun.choice import Choice, Chosen
from cqrun.contract import Plugin, Spec, quantity
from cqrun.explain import KEY, complaint, finding, listed, retold, suggest
from cqrun.registry import plugins

TERMS = "material_term"
"""Kind of the plug-ins whose names are keys of a material."""

TERMS_MARK = "x-cqrun-terms"
"""JSON schema key that says that plug-ins of a kind are properties here."""


class Material(Spec):
    """A sum of terms: `elastic` is chosen; every other key is the name of a term, such as `viscosity`."""

    model_config = ConfigDict(extra="allow", json_schema_extra={TERMS_MARK: TERMS})

    density: float = quantity("kg/m^3", "Density at rest", differentiable=True, gt=0)
    elastic: Annotated[Chosen[Plugin], Choice("elastic")] = Field(description="Elastic law")

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
            findings += [retold(e) for e in error.errors(include_url=False)]
        if findings:
            raise complaint("Material", findings)
        return material


def _term(name: str, value: Any, cls: type[Material], findings: list[InitErrorDetails]) -> Plugin | None:
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
        findings += [retold(e, (name,)) for e in error.errors(include_url=False)]
        return None
    return term
