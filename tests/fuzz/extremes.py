"""Every numeric field of the schema with numbers at the edges of what machines hold."""

from __future__ import annotations

import copy
import typing
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cqrun.explain import Loc
from cqrun.plugin.contract import Spec
from cqrun.plugin.reference import field_types
from cqrun.scene.document import write
from cqrun.scene.keypath import joined, value_at
from cqrun.scene.load import load_scene, resolve
from cqrun.scene.walk import parts

EXTREMES = (10**400, 2**64, 2**63 - 1, 10**12, 10**6, 1e308, 1e30, 1e19, 1e-320, 1e-100, 1e-30, 1e-9, 0, -1, -1e30)
"""Numbers too large, too small, and at the ends of what a scene may have."""


@dataclass(frozen=True)
class NumericField:
    """A field that holds numbers, and a scene that has it."""

    scene: Path
    data: dict[str, Any]
    part: Loc
    owner: type[Spec]
    name: str

    def __str__(self) -> str:
        return f"{self.owner.__name__}.{self.name} ({self.scene.stem}: {joined(self.part)})"

    def text(self, number: Any) -> str:
        """Return the scene with a number in the field: in its place, or as the first entry of what it holds."""
        data = copy.deepcopy(self.data)
        holder, key = value_at(data, self.part) if self.part else data, self.name
        if key not in holder:
            holder[key] = _made(field_types(self.owner)[key], len(self.data["world"]["size"]))
        while isinstance(holder[key], (list, dict)):
            holder = holder[key]
            key = next(iter(holder)) if isinstance(holder, dict) else 0
        holder[key] = number
        return write(data)


def numeric_fields(scenes: Iterable[Path]) -> Iterator[NumericField]:
    """Yield every field of the schema that holds numbers, once, in the first scene that has its part."""
    seen = set()
    for path in scenes:
        scene = load_scene(path)
        data = resolve(scene)
        for loc, part in parts(scene):
            for name, annotation in field_types(type(part)).items():
                if (type(part), name) not in seen and _holds_numbers(annotation):
                    seen.add((type(part), name))
                    yield NumericField(path, data, loc, type(part), name)


def _holds_numbers(annotation: Any) -> bool:
    """Return whether a field's type is a number, or is made of numbers."""
    if annotation in (int, float):
        return True
    arguments = typing.get_args(annotation)
    if typing.get_origin(annotation) is typing.Annotated:
        arguments = arguments[:1]
    return any(_holds_numbers(argument) for argument in arguments)


def _made(annotation: Any, dim: int) -> Any:
    """Return a value of a type that holds numbers."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation in (int, float):
        return 1
    if origin is typing.Annotated:
        return _made(arguments[0], dim)
    if origin is list:
        return [_made(arguments[0], dim)] * dim
    if origin is dict:
        return {"a": _made(arguments[1], dim)}
    return _made(next(argument for argument in arguments if _holds_numbers(argument)), dim)
