"""The JSON schema: its references are complete, and it agrees with the loader about valid and invalid scenes."""

from __future__ import annotations

import re
from typing import Any

import pytest

from cqrun.plugin.registry import plugins
from cqrun.scene.document import read
from cqrun.scene.load import load_scene
from cqrun.scene.schema_json import scene_json_schema

SCHEMA = scene_json_schema()
TYPES: dict[str, Any] = {
    "object": dict,
    "array": list,
    "string": str,
    "boolean": bool,
    "integer": int,
    "number": (int, float),
    "null": type(None),
}


def accepts(schema: Any, data: Any) -> bool:
    """Return whether data are valid, for the keywords that the scene schema uses (the same in draft-07 and 2020-12)."""
    if isinstance(schema, bool):
        return schema
    if "$ref" in schema and not accepts(SCHEMA["$defs"][schema["$ref"].removeprefix("#/$defs/")], data):
        return False
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if kinds and not any(isinstance(data, TYPES[k]) and not (isinstance(data, bool) and k != "boolean") for k in kinds):
        return False
    if "const" in schema and data != schema["const"]:
        return False
    if "enum" in schema and data not in schema["enum"]:
        return False
    if "anyOf" in schema and not any(accepts(s, data) for s in schema["anyOf"]):
        return False
    if not all(accepts(s, data) for s in schema.get("allOf", [])):
        return False
    if isinstance(data, dict):
        return _mapping(schema, data)
    if isinstance(data, list):
        fits = schema.get("minItems", 0) <= len(data) <= schema.get("maxItems", 10**9)
        return fits and all(accepts(schema.get("items", True), item) for item in data)
    if isinstance(data, (int, float)):
        return (
            data > schema.get("exclusiveMinimum", -1e300)
            and data < schema.get("exclusiveMaximum", 1e300)
            and schema.get("minimum", -1e300) <= data <= schema.get("maximum", 1e300)
        )
    return True


def _mapping(schema: Any, data: dict[str, Any]) -> bool:
    if not schema.get("minProperties", 0) <= len(data) <= schema.get("maxProperties", 10**9):
        return False
    if not set(schema.get("required", [])) <= data.keys():
        return False
    for key, value in data.items():
        patterns = [s for p, s in schema.get("patternProperties", {}).items() if re.search(p, key)]
        known = [schema["properties"][key]] if key in schema.get("properties", {}) else patterns
        if not all(accepts(s, value) for s in known or [schema.get("additionalProperties", True)]):
            return False
    return True


def test_every_reference_has_a_definition() -> None:
    text = repr(SCHEMA)
    assert set(re.findall(r"'#/\$defs/([^']+)'", text)) <= SCHEMA["$defs"].keys()
    assert "x-cqrun" not in text
    assert "prefixItems" not in text


@pytest.mark.parametrize("kind", ["shape", "sampling", "elastic", "material_term", "boundary", "load"])
def test_the_schema_lists_every_plugin(kind: str) -> None:
    for name, cls in plugins(kind).items():
        definition = SCHEMA["$defs"][f"{kind}.{name}"]
        definition = definition["anyOf"][0] if cls.shorthand else definition
        assert definition["properties"].keys() == cls.model_fields.keys()


def test_the_schema_accepts_what_loads(beam: str) -> None:
    assert accepts(SCHEMA, read(beam).data)
    box = "{box: {corner: [0.05, 0.04], size: [0.1, 0.02]}}"
    union = beam.replace(f"shape: {box}", f"shape: {{union: [{box}, {{difference: [{box}, {box}]}}]}}")
    load_scene(union)
    assert accepts(SCHEMA, read(union).data)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("density:", "densty:"),
        ("1070", "-1070"),
        ("0.45", "0.5"),
        ("fixed_corotated:", "fixed_corrotated:"),
        ("viscosity: {shear: 100}", "viscosity: {sheer: 100}"),
        ("particles_per_cell: 4", "particles_per_cell: four"),
        ("shape: {box: {", "shape: {ball: {"),
        ("  beam:", "  my-beam:"),
        ("cqrun: 1", "cqrun: 2"),
        ("64MiB", "[64]"),
        ("[0.2, 0.1]", "[0.2]"),
        ("scale: log", "scale: logarithmic"),
    ],
)
def test_the_schema_refuses_what_does_not_load(old: str, new: str, beam: str) -> None:
    assert not accepts(SCHEMA, read(beam.replace(old, new, 1)).data)
