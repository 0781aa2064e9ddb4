"""The base classes of plug-ins: frozen, validated parts of a scene.

A plug-in is a pydantic model. Its fields are its YAML keys, and its docstring is its `cqrun describe` page.
`quantity(...)` gives a field its unit and declares whether gradients reach it.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from annotated_types import MaxLen, MinLen
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    ValidationError,
    model_validator,
)
from pydantic.config import JsonDict
from pydantic_core import ErrorDetails, InitErrorDetails

from cqrun.explain import Loc, complaint, merge_alternatives, reworded


class Spec(BaseModel):
    """A frozen part of a scene; unknown keys, and text instead of numbers, are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    _folder: Path = PrivateAttr(default=Path())

    def set_folder(self, folder: Path) -> None:
        """Set the folder to which the file names in it (`reference.FileName`) are relative."""
        self._folder = folder

    def path_of(self, file: str) -> Path:
        """Return the path of a file that one of its fields names."""
        return from_folder(self._folder, file)

    @model_validator(mode="wrap")
    @classmethod
    def _complain_in_words(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            return handler(data)
        except ValidationError as error:
            findings = [cls._reworded(e) for e in merge_alternatives(error.errors(include_url=False))]
            raise complaint(cls.__name__, findings) from None

    @classmethod
    def _reworded(cls, error: ErrorDetails) -> InitErrorDetails:
        """Return a finding in cqrun's words, with this model's legal keys and the field's description and unit."""
        name = str(error["loc"][0]) if error["loc"] else ""
        if name not in cls.model_fields:
            return reworded(error, keys=cls.model_fields)
        about = cls.model_fields[name].description or ""
        return reworded(error, about=about, unit=field_unit(cls, name))

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions, as (place inside this part, message).

        Checks the vectors, which are the fields with 2 to 3 entries. Parts inside this part are checked separately.
        """
        problems: list[tuple[Loc, str]] = []
        for name in type(self).model_fields:
            value = getattr(self, name)
            if is_vector(type(self), name) and isinstance(value, list) and len(value) != dim:
                problems.append(((name,), f"must have {dim} entries in this {dim}D world, has {len(value)}"))
        return problems


def from_folder(folder: Path, file: str) -> Path:
    """Return where a file is that is named from a folder on, absolutely or from the user's home (`~`)."""
    return folder / os.path.expanduser(file)  # noqa: PTH111 (that of Path fails where there is no such user)


class Plugin(Spec):
    """A part of a scene that is chosen by name; `registry.plugin` sets `kind` and `name`.

    `shorthand` is the name of a field, if any: a value that is not a mapping is the value of that field. If a plug-in
    `stands_alone`, a scene may omit even its name: text in place of the choice is the value of its shorthand field.
    """

    kind: ClassVar[str] = ""
    name: ClassVar[str] = ""
    shorthand: ClassVar[str] = ""
    stands_alone: ClassVar[bool] = False


def quantity(
    unit: str, description: str, *, differentiable: bool = False, geometric: bool = False, **constraints: Any
) -> Any:
    """Return a pydantic field with a unit.

    Args:
        unit: SI unit as printed, such as `Pa`, `m/s` or `1`.
        description: one line for `cqrun describe` and the JSON schema.
        differentiable: whether the engine's adjoint reaches the field, so that it can be an unknown.
        geometric: whether particles follow the field where it shapes or places a body; there it can be an unknown.
        constraints: pydantic's (`gt`, `le`, `default`, ...).
    """
    extra: JsonDict = {"unit": unit, "differentiable": differentiable}
    if geometric:
        extra["geometric"] = True
    return Field(description=f"{description} [{unit}]", json_schema_extra=extra, **constraints)


def vector(
    unit: str, description: str, *, differentiable: bool = False, geometric: bool = False, **constraints: Any
) -> Any:
    """Return a pydantic field for a `list[float]` with one entry per dimension of the world.

    The scene checks the length against its world. The arguments are those of `quantity`.
    """
    limits = {"min_length": 2, "max_length": 3}
    return quantity(unit, description, differentiable=differentiable, geometric=geometric, **limits, **constraints)


def is_vector(spec: type[BaseModel], name: str) -> bool:
    """Return whether a field has one entry per dimension: a list of 2 to 3 entries."""
    metadata = spec.model_fields[name].metadata
    return MinLen(2) in metadata and MaxLen(3) in metadata


def field_unit(spec: type[BaseModel], name: str) -> str | None:
    """Return the unit of a field, or None if it has none or is a name that the user gave."""
    extra = spec.model_fields[name].json_schema_extra if name in spec.model_fields else None
    return str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else None


def is_differentiable(spec: type[BaseModel], name: str) -> bool:
    """Return whether gradients reach a field."""
    extra = spec.model_fields[name].json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("differentiable"))


def is_geometric(spec: type[BaseModel], name: str) -> bool:
    """Return whether particles follow a field where it shapes or places a body."""
    extra = spec.model_fields[name].json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("geometric"))


Array = np.ndarray
"""A NumPy array; docstrings give its shape and unit."""
