"""Section `path`: the values that a body goes through, from one equilibrium to the next (`cqrun rest`)."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidatorFunctionWrapHandler, WrapValidator

from cqrun.explain import shown
from cqrun.plugin.contract import Spec

ACTIVATION = "activation."
"""How a key of the section begins that is the activation of an actuator, or of a part of one."""

MOST_POINTS = 10_000
"""Largest number of points in a path."""


class Ramp(Spec):
    """Values at equal distances."""

    first: float = Field(description="First value, in the unit of the key")
    last: float = Field(description="Last value, in the unit of the key")
    points: int = Field(description="Number of values", ge=2, le=MOST_POINTS)

    @property
    def values(self) -> list[float]:
        """The values, first and last included."""
        step = (self.last - self.first) / (self.points - 1)
        return [self.first + k * step for k in range(self.points - 1)] + [self.last]


_List = Annotated[list[float], Field(min_length=1, max_length=MOST_POINTS)]
_LIST: TypeAdapter[list[float]] = TypeAdapter(_List, config=ConfigDict(strict=True, allow_inf_nan=False))


def _list_or_ramp(value: Any, _: ValidatorFunctionWrapHandler) -> list[float] | Ramp:
    """Return the entry by what it looks like, so that a mistake has one message and not one of each alternative."""
    if isinstance(value, Ramp):
        return value
    if isinstance(value, dict):
        return Ramp.model_validate(value)
    if isinstance(value, list):
        return _LIST.validate_python(value)
    raise ValueError(f"must be a list of values, or a ramp with `first`, `last` and `points`, is {shown(value)}")


PathValues = Annotated[_List | Ramp, WrapValidator(_list_or_ramp)]
"""A list of values, or a ramp."""


def values_of(entry: list[float] | Ramp) -> list[float]:
    """Return the values of an entry of the section."""
    return entry.values if isinstance(entry, Ramp) else list(entry)
