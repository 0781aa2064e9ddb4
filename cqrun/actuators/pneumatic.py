"""Pneumatic chamber: a body part that a pressure inside expands (CQ1 V-A, CQ2 3.4)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from cqrun.actuators import muscle, pressure
from cqrun.actuators.actuator import DirectedStress
from cqrun.explain import Loc
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("actuator", "pneumatic")
class Pneumatic(DirectedStress):
    """A chamber under pressure; a positive activation expands it.

    law `pressure`: tau = -p J I with p = activation max_pressure, activation 0 to 1: a fluid pressure on the deformed
    volume. law `chainqueen`: tau = -F S F^T with S = activation max_pressure I, or along an axis, activation -1 to 1:
    what the papers call a chamber. With `incompressibility` in the material the chamber is hydraulic.
    """

    axis: list[float] | Literal["isotropic"] = Field(
        description="Direction at rest that it expands along (law chainqueen); or isotropic", default="isotropic"
    )
    max_pressure: float = quantity("Pa", "Pressure at activation 1", differentiable=True, ge=0)
    law: Literal["pressure", "chainqueen"] = Field(description="Which stress", default="pressure")

    scale = "max_pressure"

    @property
    def limits(self) -> tuple[float, float]:
        """The least and greatest activation."""
        return (0.0, 1.0) if self.law == "pressure" else (-1.0, 1.0)

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        found = super().dim_problems(dim)
        if self.law == "pressure" and self.axis != "isotropic":
            found.append((("axis",), "a fluid's pressure acts all ways: leave it out, or use `law: chainqueen`"))
        return found

    @property
    def kernel(self) -> type:  # type: ignore[override]
        """The class of the kernels' view, of the law."""
        return pressure.PressureKernel if self.law == "pressure" else muscle.MuscleKernel

    def constants(self, x: Array) -> Array:
        """Return the pressure (1,), or S as rows (D (D + 1) / 2,), at activation and strength 1."""
        return np.ones(1) if self.law == "pressure" else -muscle.symmetric_rows(self.direction(x.shape[1]))
