"""Pneumatic chamber: a part of a body that an inner pressure expands (CQ1 V-A, CQ2 3.4)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from cqrun.actuators import muscle, pressure
from cqrun.actuators.actuator import DirectedStress
from cqrun.explain import Loc
from cqrun.numerics.symmetric import symmetric_rows
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("actuator", "pneumatic")
class Pneumatic(DirectedStress):
    """A chamber under pressure; a positive activation expands it.

    law `pressure`: a fluid pressure on the deformed volume, tau = -p J I with p = activation max_pressure, activation 0
    to 1. law `chainqueen`: the chamber of the papers, tau = -F S F^T with S = activation max_pressure I, or along an
    axis, activation -1 to 1. With `incompressibility` in the material the chamber is hydraulic.
    """

    axis: list[float] | Literal["isotropic"] = Field(
        description="Direction of expansion at rest (law chainqueen); or isotropic", default="isotropic"
    )
    max_pressure: float = quantity("Pa", "Pressure at activation 1", differentiable=True, ge=0)
    law: Literal["pressure", "chainqueen"] = Field(description="Law of the stress", default="pressure")

    scale = "max_pressure"

    @property
    def limits(self) -> tuple[float, float]:
        """The smallest and largest activation."""
        return (0.0, 1.0) if self.law == "pressure" else (-1.0, 1.0)

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        problems = super().dim_problems(dim)
        if self.law == "pressure" and self.axis != "isotropic":
            problems.append((("axis",), "a fluid's pressure has no direction: remove it, or use `law: chainqueen`"))
        return problems

    @property
    def kernel(self) -> type:  # type: ignore[override]
        """The class of the kernels' view for the law."""
        return pressure.PressureKernel if self.law == "pressure" else muscle.MuscleKernel

    def potential(self, constants: Array, x: Array, F: Array) -> Array:
        """Return the energy per volume at rest (T, n), for a pressure of 1: -J, or as a muscle's."""
        return -np.linalg.det(F) if self.law == "pressure" else super().potential(constants, x, F)

    def potential_vjp(self, constants: Array, x: Array, F: Array, bar: Array) -> tuple[Array | None, Array | None]:
        """Return the cotangents of x and F; None for zero."""
        if self.law != "pressure":
            return super().potential_vjp(constants, x, F, bar)
        J = np.linalg.det(F)[..., None, None]
        return None, -bar[..., None, None] * J * np.swapaxes(np.linalg.inv(F), -1, -2)

    def constants(self, x: Array) -> Array:
        """Return the pressure (1,), or S as rows (D (D + 1) / 2,), at activation and strength 1."""
        return np.ones(1) if self.law == "pressure" else -symmetric_rows(self.direction(x.shape[1]))
