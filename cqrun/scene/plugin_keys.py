"""Parts of a scene whose further keys are the names of plug-ins of one kind, such as the terms of a material."""

from __future__ import annotations

from typing import Any, ClassVar, Self

from pydantic import ConfigDict, GetJsonSchemaHandler, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, InitErrorDetails

from cqrun.explain import KEY, complaint, finding, listed, reworded, suggest
from cqrun.plugin.contract import Plugin, Spec
from cqrun.plugin.registry import plugins

KEYS_MARK = "x-cqrun-keys"
"""JSON schema key which marks that plug-ins of a kind are properties here."""


class PluginKeys(Spec):
    """A part whose keys, besides its fields, are the names of plug-ins of the kind `keys_of`."""

    model_config = ConfigDict(extra="allow")
    keys_of: ClassVar[str]

    @property
    def chosen(self) -> dict[str, Any]:
        """The plug-ins by name, in alphabetical order."""
        return dict(sorted((self.model_extra or {}).items()))

    @model_validator(mode="wrap")
    @classmethod
    def _with_plugins(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(data, dict):
            return handler(data)
        findings: list[InitErrorDetails] = []
        built = {k: v if k in cls.model_fields else cls._plugin(k, v, findings) for k, v in data.items()}
        try:
            part = handler(built)
        except ValidationError as error:
            findings += [reworded(e) for e in error.errors(include_url=False)]
        if findings:
            raise complaint(cls.__name__, findings)
        return part

    @classmethod
    def _plugin(cls, name: str, value: Any, findings: list[InitErrorDetails]) -> Plugin | None:
        """Return the validated plug-in, or add to the findings."""
        legal = plugins(cls.keys_of)
        if name not in legal:
            keys = [*cls.model_fields, *legal]
            message = f"unknown key{suggest(name, keys)}; keys here: {listed(keys)}"
            findings.append(finding(message, (name,), kind=KEY))
            return None
        try:
            plugin: Plugin = legal[name].model_validate(value)
        except ValidationError as error:
            findings += [reworded(e, (name,)) for e in error.errors(include_url=False)]
            return None
        return plugin

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {**handler.resolve_ref_schema(handler(schema)), KEYS_MARK: cls.keys_of}
