"""What every plug-in is: a frozen, validated piece of a scene.

A plug-in is a pydantic model. Its fields are its YAML keys, its docstring is its
`cqrun describe` page, `quantity(...)` gives a field its unit and says whether gradients reach it.
"""

from __future__ import annotations

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

from cqrun.explain import Loc, complaint, lists_or_words, retold


class Spec(BaseModel):
    """A frozen part of a scene; unknown keys and text in place of numbers are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)

    _folder: Path = PrivateAttr(default=Path())

    def set_folder(self, folder: Path) -> None:
        """Take the names of its files (`reference.FileName`) from this folder on."""
        self._folder = folder

    def path_of(self, file: str) -> Path:
        """Return where a file is that a field of it names."""
        return self._folder / file

    @model_validator(mode="wrap")
    @classmethod
    def _complain_in_words(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            return handler(data)
        except ValidationError as error:
            findings = [cls._retold(e) for e in lists_or_words(error.errors(include_url=False))]
            raise complaint(cls.__name__, findings) from None

    @classmethod
    def _retold(cls, error: ErrorDetails) -> InitErrorDetails:
        """Tell a finding with what this model knows: its legal keys, the field's description and unit."""
        name = str(error["loc"][0]) if error["loc"] else ""
        if name not in cls.model_fields:
            return retold(error, keys=cls.model_fields)
        about = cls.model_fields[name].description or ""
        return retold(error, about=about, unit=field_unit(cls, name))

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions, each with its place inside this part.

        Vectors, the fields with 2 to 3 entries, are found here; parts inside this one are asked apart.
        """
        found: list[tuple[Loc, str]] = []
        for name in type(self).model_fields:
            value = getattr(self, name)
            if is_vector(type(self), name) and isinstance(value, list) and len(value) != dim:
                found.append(((name,), f"must have {dim} entries in this {dim}D world, has {len(value)}"))
        return found


class Plugin(Spec):
    """A part of a scene that is chosen by name; `registry.plugin` sets `kind` and `name`.

    `shorthand` names the field that a value which is no mapping stands for, if any. Of a plug-in that
    `stands_alone`, even its name may be left out: a bare text in the place of the choice is its shorthand.
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
        differentiable: the field may be an unknown: the engine's adjoint reaches it.
        geometric: the field may be an unknown where it shapes or places a body: particles follow it.
        constraints: pydantic's own (`gt`, `le`, `default`, ...).
    """
    extra: JsonDict = {"unit": unit, "differentiable": differentiable}
    if geometric:
        extra["geometric"] = True
    return Field(description=f"{description} [{unit}]", json_schema_extra=extra, **constraints)


def vector(
    unit: str, description: str, *, differentiable: bool = False, geometric: bool = False, **constraints: Any
) -> Any:
    """Return a pydantic field for a `list[float]` with one entry a dimension of the world.

    The scene checks the length against its world. Arguments as `quantity`.
    """
    limits = {"min_length": 2, "max_length": 3}
    return quantity(unit, description, differentiable=differentiable, geometric=geometric, **limits, **constraints)


def is_vector(spec: type[BaseModel], name: str) -> bool:
    """Say whether a field holds one entry a dimension: a list of 2 to 3 entries."""
    metadata = spec.model_fields[name].metadata
    return MinLen(2) in metadata and MaxLen(3) in metadata


def field_unit(spec: type[BaseModel], name: str) -> str | None:
    """Return the unit of a field, or None where it has none, or is no field but a name of the user's."""
    extra = spec.model_fields[name].json_schema_extra if name in spec.model_fields else None
    return str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else None


def is_differentiable(spec: type[BaseModel], name: str) -> bool:
    """Say whether gradients reach a field."""
    extra = spec.model_fields[name].json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("differentiable"))


def is_geometric(spec: type[BaseModel], name: str) -> bool:
    """Say whether particles follow a field where it shapes or places a body."""
    extra = spec.model_fields[name].json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("geometric"))


Array = np.ndarray
"""A NumPy array; the docstring that uses it gives shape and unit."""
