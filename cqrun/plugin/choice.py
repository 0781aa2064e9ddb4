"""`{name: {...}}`: exactly one plug-in of a kind, chosen by its name.

    elastic: Annotated[Chosen[Elastic], Choice("elastic")]

The registry is read when a value is validated, so a plug-in file that is added later is found too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic_core import CoreSchema, core_schema

from cqrun.explain import KEY, complaint, finding, listed, reworded, shown, suggest
from cqrun.plugin import registry
from cqrun.plugin.contract import Plugin

P = TypeVar("P", bound=Plugin, covariant=True)

CHOICE_MARK = "x-cqrun-choice"
"""JSON schema key that marks a choice of a kind until `scene_json_schema` replaces it by the plug-ins."""


@dataclass(frozen=True)
class Chosen(Generic[P]):
    """A chosen plug-in: its `name`, and the validated instance in `value`."""

    name: str
    value: P


@dataclass(frozen=True)
class Choice:
    """Annotation of a field that chooses one plug-in of `kind`; the value of the field is a `Chosen`.

    If a plug-in's class sets `shorthand` to the name of a field, a scene may give the value of that field alone:
    `{union: [...]}` for `{union: {shapes: [...]}}`.
    """

    kind: str

    def validate(self, data: Any) -> Chosen[Plugin]:
        """Return the chosen plug-in of a one-key mapping, or raise pydantic's ValidationError."""
        legal = registry.plugins(self.kind)
        if isinstance(data, Chosen):
            if data.value.kind not in {self.kind, *(cls.kind for cls in legal.values())}:
                raise self._complaint(f"must be a {self.kind}, is a {data.value.kind}")
            return data
        if isinstance(data, str):
            data = next(({name: data} for name, cls in legal.items() if cls.stands_alone), data)
        if not isinstance(data, dict):
            raise self._complaint(_no_mapping(data, legal))
        if len(data) != 1:
            named = [str(name) for name in data]
            raise self._complaint(f"must name exactly one of {listed(legal)}; has {listed(named)}", named)
        ((name, value),) = data.items()
        if name not in legal:
            message = f"no {self.kind} has this name{suggest(name, legal)}; legal names: {listed(legal)}"
            raise complaint(self.kind, [finding(message, (str(name),), kind=KEY)])
        return Chosen(name, self._build(name, legal[name], value))

    def _build(self, name: str, cls: type[Plugin], value: Any) -> Plugin:
        if cls.shorthand and not isinstance(value, (dict, cls)):
            value = {cls.shorthand: value}
        try:
            return cls.model_validate(value)
        except ValidationError as error:
            findings = [reworded(e, (name,)) for e in error.errors(include_url=False)]
            raise complaint(self.kind, findings) from None

    def _complaint(self, message: str, involves: Sequence[str] = ()) -> ValidationError:
        return complaint(self.kind, [finding(message, involves=involves)])

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        dump = core_schema.plain_serializer_function_ser_schema(_dump, info_arg=True)
        return core_schema.no_info_plain_validator_function(self.validate, serialization=dump)

    def __get_pydantic_json_schema__(self, _: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {CHOICE_MARK: self.kind}


def _no_mapping(data: Any, legal: dict[str, type[Plugin]]) -> str:
    """Return what is wrong with a choice that is not a mapping."""
    if isinstance(data, str) and data in legal:
        inside = "{...}" if any(field.is_required() for field in legal[data].model_fields.values()) else "{}"
        return f"must be a mapping `name: {{...}}`, is {shown(data)}: write `{{{data}: {inside}}}`"
    near = suggest(data, legal) if isinstance(data, str) else ""
    return f"must be a mapping `name: {{...}}` with one of {listed(legal)}, is {shown(data)}{near}"


def _dump(chosen: Chosen[Plugin], info: core_schema.SerializationInfo) -> dict[str, Any]:
    return {chosen.name: chosen.value.model_dump(exclude_none=bool(info.exclude_none))}
