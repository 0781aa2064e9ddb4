"""Field types that several parts of a scene share: names, memory, substeps."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Annotated, Any, Literal

import psutil
from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator, WithJsonSchema

from cqrun.explain import Loc, shown
from cqrun.units import format_bytes, parse_bytes

if TYPE_CHECKING:
    from cqrun.plugin.contract import Spec

_IDENTIFIER = r"[A-Za-z_][A-Za-z0-9_]*"


def _identifier(name: str) -> str:
    if not re.fullmatch(_IDENTIFIER, name):
        raise ValueError(f"a name has letters, digits and _, and does not begin with a digit; '{name}' is not a name")
    return name


Name = Annotated[str, AfterValidator(_identifier), WithJsonSchema({"type": "string", "pattern": f"^{_IDENTIFIER}$"})]
"""The name of a body, group, boundary, ...: an identifier, so that key paths need no quotes."""


def _bytes(value: Any) -> int:
    if isinstance(value, str):
        return parse_bytes(value)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"must be an amount of memory such as 2GiB or 500MB, is {shown(value)}")
    return value


def _fits_machine(count: int) -> int:
    total = psutil.virtual_memory().total
    if count > total:
        raise ValueError(f"asks for {format_bytes(count)}, but this machine has {format_bytes(total)}: give less")
    return count


Memory = Annotated[
    int,
    BeforeValidator(_bytes),
    Field(gt=0),
    AfterValidator(_fits_machine),
    WithJsonSchema({"type": ["integer", "string"], "examples": ["2GiB", "500MB"]}),
]
"""A number of bytes, given as a whole number or as text such as `2GiB`; at most the memory of the machine."""


def _substeps(value: Any) -> int | str:
    whole = isinstance(value, int) and not isinstance(value, bool)
    if value == "auto" or (whole and value >= 1):
        return value
    raise ValueError(f"must be auto or a whole number from 1 on, is {shown(value)}")


Substeps = Annotated[
    int | Literal["auto"],
    PlainValidator(_substeps),
    WithJsonSchema({"anyOf": [{"const": "auto"}, {"type": "integer", "minimum": 1}]}),
]
"""The number of substeps per control step, or `auto`."""

Seed = Annotated[int, Field(ge=0)]
Vector = Annotated[list[float], Field(min_length=2, max_length=3)]
Interval = Annotated[list[float], Field(min_length=2, max_length=2)]


def turning_problems(part: Spec, names: tuple[str, ...], dim: int) -> list[tuple[Loc, str]]:
    """Return the fields that need as many entries as a world of `dim` dimensions has rotations, and have others."""
    count = 1 if dim == 2 else 3
    return [
        ((name,), f"must have {'one entry' if dim == 2 else '3 entries'} in this {dim}D world, has {len(value)}")
        for name in names
        if (value := getattr(part, name)) is not None and len(value) != count
    ]
