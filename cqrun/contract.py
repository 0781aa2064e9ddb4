"""What every plug-in is: a frozen, validated piece of a scene.

A plug-in is a pydantic model. Its fields are its YAML keys, its docstring is its
`cqrun describe` page, `quantity(...)` gives a field its unit and says whether gradients reach it.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field


class Spec(BaseModel):
    """A frozen part of a scene; unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Plugin(Spec):
    """A part of a scene that is chosen by name; `registry.plugin` sets `kind` and `name`."""

    kind: ClassVar[str] = ""
    name: ClassVar[str] = ""


def quantity(unit: str, description: str, *, differentiable: bool = False, **constraints: Any) -> Any:
    """Return a pydantic field with a unit.

    Args:
        unit: SI unit as printed, such as `Pa`, `m/s` or `1`.
        description: one line for `cqrun describe` and the JSON schema.
        differentiable: the field may be an unknown: the engine's adjoint reaches it.
        constraints: pydantic's own (`gt`, `le`, `default`, ...).
    """
    extra = {"unit": unit, "differentiable": differentiable}
    return Field(description=f"{description} [{unit}]", json_schema_extra=extra, **constraints)


def field_unit(spec: type[BaseModel], name: str) -> str | None:
    """Return the unit of a field, or None where it has none."""
    extra = spec.model_fields[name].json_schema_extra
    return str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else None


def is_differentiable(spec: type[BaseModel], name: str) -> bool:
    """Say whether gradients reach a field."""
    extra = spec.model_fields[name].json_schema_extra
    return isinstance(extra, dict) and bool(extra.get("differentiable"))


Array = np.ndarray
"""A NumPy array; the docstring that uses it gives shape and unit."""
