"""Types that mark what a field means: the name of a body, group, goal, actuator, boundary or file, or a position.

    carrier: BodyName = Field(description="Body that carries the sensor")
    hold: GroupName = Field(description="Group of that body")
    recording_path: FileName = Field(description="What the sensor recorded")

By these types a scene finds the names in its parts, also in lists and mappings, whatever the fields are called. So it
can refuse unknown names, and can include the content of files in the inputs that determine the name of a run.
"""

from __future__ import annotations

import errno
import os
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import GetJsonSchemaHandler
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema

from cqrun.explain import Loc
from cqrun.plugin.contract import Spec

FILLED_MARK = "x-cqrun-filled"
"""JSON schema key of a field that a user may omit; `scene_json_schema` removes the field from the required ones."""

M = TypeVar("M")


@dataclass(frozen=True)
class NamesBody:
    """Mark of the name of one of the scene's bodies."""


@dataclass(frozen=True)
class NamesGroup:
    """Mark of the name of a group of a body, or of a region of the scene.

    The field `of` gives the body. If `of` is None, the first body field of the part gives it, or, if the part has no
    such field, a part around it does.
    """

    of: str | None = None


@dataclass(frozen=True)
class NamesRegion:
    """Mark of the name of a region of the scene; where particles are selected, also of a group of their body."""


@dataclass(frozen=True)
class NamesGoal:
    """Mark of the name of one of the scene's goals."""


@dataclass(frozen=True)
class NamesActuator:
    """Mark of the name of one of the scene's actuators."""


@dataclass(frozen=True)
class NamesBoundary:
    """Mark of the name of one of the scene's boundaries."""


@dataclass(frozen=True)
class NamesRigid:
    """Mark of the name of one of the scene's rigid bodies."""


@dataclass(frozen=True)
class NamesForce:
    """Mark of the name of one of the scene's forces without an activation, such as a spring."""


@dataclass(frozen=True)
class NamesMeasure:
    """Mark of the name of one of the scene's measured quantities."""


@dataclass(frozen=True)
class NamesFile:
    """Mark of the name of a file, relative to the scene's folder. `Spec.path_of` returns its path."""


@dataclass(frozen=True)
class NamesFace:
    """Mark of the name of a face of the world."""


@dataclass(frozen=True)
class InWorld:
    """Mark of a position that must lie in the world [m]; its coordinates begin at the entry `first`."""

    first: int = 0


@dataclass(frozen=True)
class FilledIn:
    """Mark of a field that a user may omit: the scene fills it in before it is checked.

    Attributes:
        by: the default; if the scene does not determine it, the field is missing.
    """

    by: Literal["zero vector", "zero spin", "only body"]

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {**handler(schema), FILLED_MARK: True}


BodyName = Annotated[str, NamesBody()]
OnlyBodyName = Annotated[str, NamesBody(), FilledIn("only body")]
"""Name of a body; a scene with a single body may omit it."""

GroupName = Annotated[str, NamesGroup()]
RegionName = Annotated[str, NamesRegion()]
GoalName = Annotated[str, NamesGoal()]
ActuatorName = Annotated[str, NamesActuator()]
BoundaryName = Annotated[str, NamesBoundary()]
RigidName = Annotated[str, NamesRigid()]
ForceName = Annotated[str, NamesForce()]
MeasureName = Annotated[str, NamesMeasure()]
FileName = Annotated[str, NamesFile()]
Position = Annotated[list[float], InWorld()]
Face = Annotated[Literal["x_min", "x_max", "y_min", "y_max", "z_min", "z_max", "all"], NamesFace()]


@dataclass(frozen=True)
class Marked(Generic[M]):
    """A value whose type has a mark.

    Attributes:
        part: the part that has the field.
        loc: place of the value inside the part: the field's name, then indices and keys.
        mark: the mark, which defines what the value means.
        value: the value; never None.
        at_key: whether the value is a key of a mapping, and not an entry.
    """

    part: Spec
    loc: Loc
    mark: M
    value: Any
    at_key: bool = False

    def below(self, loc: Loc) -> Marked[M]:
        """Return the same value with the place of its part, `loc`, before its own."""
        return replace(self, loc=(*loc, *self.loc))


def marked_in(part: Spec, kind: type[M]) -> Iterator[Marked[M]]:
    """Yield the values of one part whose types have a mark of class `kind`, without those of parts inside it."""
    annotations = field_types(type(part))
    for name in marked_fields(type(part), kind):
        for found in _marked(annotations[name], Marked(part, (name,), None, getattr(part, name))):
            if isinstance(found.mark, kind):
                yield found


def marked_fields(cls: type[Spec], kind: type[Any]) -> tuple[str, ...]:
    """Return the names of a part's fields whose types have a mark of a kind, in order."""
    return _marked_fields(cls, kind)  # type: ignore[arg-type]  # mypy does not know that a class can be hashed


@cache
def _marked_fields(cls: type[Spec], kind: type[Any]) -> tuple[str, ...]:
    return tuple(name for name, info in cls.model_fields.items() if marks(info, kind))


def marks(info: FieldInfo, kind: type[M]) -> list[M]:
    """Return the marks of a kind in a field's type, without duplicates."""
    return list(dict.fromkeys(mark for mark in _metadata(_type_of(info)) if isinstance(mark, kind)))


@cache
def field_types(cls: type[Spec]) -> dict[str, Any]:
    """Return the types of the fields of a part, with all their marks."""
    return {name: _type_of(info) for name, info in cls.model_fields.items()}


def body_of(part: Spec) -> str | None:
    """Return the name in the first body field of a part; None if it has no such field or not a single name there."""
    fields = marked_fields(type(part), NamesBody)
    value = getattr(part, fields[0]) if fields else None
    return value if isinstance(value, str) else None


def is_union(annotation: Any) -> bool:
    """Return whether a type is a union of several types."""
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)


def _type_of(info: FieldInfo) -> Any:
    """Return the type of a field, with the marks that pydantic has removed from it."""
    return Annotated[(info.annotation, *info.metadata)] if info.metadata else info.annotation


def _metadata(annotation: Any) -> Iterator[Any]:
    """Yield the annotations of a type, and of the types inside it."""
    args = typing.get_args(annotation)
    if typing.get_origin(annotation) is Annotated:
        yield from args[1:]
        args = args[:1]
    for arg in args:
        yield from _metadata(arg)


def _marked(annotation: Any, at: Marked[Any]) -> Iterator[Marked[Any]]:
    """Yield a value, and the values inside it, once for each mark of its type."""
    origin, args, value = typing.get_origin(annotation), typing.get_args(annotation), at.value
    if value is None or (is_union(annotation) and any(value in typing.get_args(a) for a in args if _is_literal(a))):
        return  # a literal, such as `all`, is not a name
    if origin is Annotated:
        yield from (replace(at, mark=mark) for mark in args[1:])
        yield from _marked(args[0], at)
    elif is_union(annotation):
        for arg in args:
            yield from _marked(arg, at)
    elif origin is list and isinstance(value, list):
        for k, item in enumerate(value):
            yield from _marked(args[0], replace(at, loc=(*at.loc, k), value=item))
    elif origin is dict and isinstance(value, dict):
        for key, item in value.items():
            yield from _marked(args[0], replace(at, loc=(*at.loc, key), value=key, at_key=True))
            yield from _marked(args[1], replace(at, loc=(*at.loc, key), value=item))


def why_unreadable(path: Path) -> str:
    """Return why the file that a field names cannot be read; nothing if it can.

    A pipe would wait for a writer, and a device may never end: only regular files are read.
    """
    try:
        if path.is_dir():
            return os.strerror(errno.EISDIR)
        if path.exists() and not path.is_file():
            return "it is a pipe or a device, not a file"
        path.open("rb").close()
    except OSError as error:
        return str(error.strerror)
    except ValueError:
        return "its name has a zero byte"
    return ""


def _is_literal(annotation: Any) -> bool:
    return typing.get_origin(annotation) is Literal
