"""The range of an observed quantity: the JSON schema and the loader accept the same values."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from cqrun.observers.ranges import Range
from cqrun.plugin.registry import plugins

RANGE = TypeAdapter(Range)


def accepts(schema: dict[str, Any], data: Any) -> bool:
    """Return whether data is valid, for the keywords that the schema of a range uses."""
    assert schema.keys() <= {"anyOf", "enum", "type", "items", "minItems", "maxItems"}
    if "anyOf" in schema:
        return any(accepts(part, data) for part in schema["anyOf"])
    if "enum" in schema:
        return data in schema["enum"]
    if schema["type"] == "array":
        long = isinstance(data, list) and schema.get("minItems", 0) <= len(data) <= schema.get("maxItems", len(data))
        return long and all(accepts(schema["items"], item) for item in data)
    return isinstance(data, {"null": type(None), "number": (int, float)}[schema["type"]])


@pytest.mark.parametrize(
    "data", ["auto", "raw", None, [0, 1], [-1.5, 2], [[0, 1]], [[0, 1], [2, 3]], "world", 1, [1], [0, 1, 2], [], [[0]]]
)
def test_schema_and_loader_agree(data):
    try:
        loaded = RANGE.validate_python(data)
    except ValidationError:
        assert not accepts(RANGE.json_schema(), data)
    else:
        assert accepts(RANGE.json_schema(), data)
        assert loaded is not None
        assert RANGE.validate_python(loaded) == loaded


@pytest.mark.parametrize("name", plugins("observer"))
def test_every_observer_has_a_range_that_may_be_null(name):
    schema = plugins("observer")[name].model_json_schema()["properties"]["range"]
    assert {"type": "null"} in schema["anyOf"]
    assert schema["description"]
