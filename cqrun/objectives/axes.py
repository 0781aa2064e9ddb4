"""Axes of the world by name, and the base of terms along one axis."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cqrun.explain import Loc
from cqrun.objectives.term import ObjectiveTerm

AXES = ("x", "y", "z")

Axis = Literal["x", "y", "z"]


class AlongAxis(ObjectiveTerm):
    """Base of terms along an axis of the world."""

    axis: Axis = Field(description="Axis of the world", default="y")

    @property
    def index(self) -> int:
        """Number of the axis."""
        return AXES.index(self.axis)

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        return [*super().dim_problems(dim), *([(("axis",), "a 2D world has no axis z")] if self.index >= dim else [])]
