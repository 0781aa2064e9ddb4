"""The JSON Schema of scenes, for editors: it lists every plug-in wherever one can be chosen."""

from __future__ import annotations

from typing import Any

from cqrun.plugin.choice import CHOICE_MARK
from cqrun.plugin.reference import FILLED_MARK
from cqrun.plugin.registry import plugins
from cqrun.scene.plugin_keys import KEYS_MARK
from cqrun.scene.schema import Scene

MARKS = (CHOICE_MARK, KEYS_MARK, FILLED_MARK)
_REF = "#/$defs/{model}"


def scene_json_schema() -> dict[str, Any]:
    """Return the schema of scene files; it is valid as draft-07, for older editors, and as 2020-12."""
    schema = Scene.model_json_schema(ref_template=_REF)
    definitions: dict[str, Any] = schema.pop("$defs")
    waiting: set[str] = set()
    body = _expanded(schema, waiting)
    done = {name: _expanded(part, waiting) for name, part in definitions.items()}
    while waiting:
        key = waiting.pop()
        if key not in done:
            done[key] = {}  # shapes contain shapes: the entry must exist before its parts are expanded
            done[key] = _definition(key, waiting, done)
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "cqrun scene"}
    return {**body, **head, "$defs": dict(sorted(done.items()))}


def _definition(key: str, waiting: set[str], done: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of `kind` (a choice) or `kind.name` (a plug-in)."""
    kind, _, name = key.partition(".")
    if not name:
        known = plugins(kind)
        options = {option: _reference(f"{cls.kind}.{option}", waiting) for option, cls in known.items()}
        choice = {
            "type": "object",
            "properties": options,
            "additionalProperties": False,
            "minProperties": 1,
            "maxProperties": 1,
        }
        return {"anyOf": [choice, {"type": "string"}]} if any(cls.stands_alone for cls in known.values()) else choice
    cls = plugins(kind)[name]
    schema = cls.model_json_schema(ref_template=_REF)
    for inner, part in schema.pop("$defs", {}).items():
        done.setdefault(inner, _expanded(part, waiting))
    schema = _expanded(schema, waiting)
    if cls.shorthand:
        return {"anyOf": [schema, schema["properties"][cls.shorthand]]}
    return schema


def _reference(key: str, waiting: set[str]) -> dict[str, str]:
    waiting.add(key)
    return {"$ref": _REF.format(model=key)}


def _expanded(node: Any, waiting: set[str]) -> Any:
    """Return a schema with its marks replaced by references to plug-ins."""
    if isinstance(node, list):
        return [_expanded(item, waiting) for item in node]
    if not isinstance(node, dict):
        return node
    result = {k: _expanded(v, waiting) for k, v in node.items() if k not in MARKS}
    if CHOICE_MARK in node:
        result["allOf"] = [_reference(node[CHOICE_MARK], waiting)]  # draft-07 ignores keys beside $ref
    if KEYS_MARK in node:
        kind = node[KEYS_MARK]
        named = {name: _reference(f"{kind}.{name}", waiting) for name in plugins(kind)}
        result |= {"properties": {**result["properties"], **named}, "additionalProperties": False}
    if isinstance(node.get("required"), list):
        fields = node.get("properties", {})
        result["required"] = [name for name in node["required"] if FILLED_MARK not in fields.get(name, {})]
    if "patternProperties" in result:
        result["additionalProperties"] = False  # pydantic gives the legal names, but does not forbid others
    return result
