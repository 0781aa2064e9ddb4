"""Slip: no motion normal to the surface, free motion along it, v - (v . n) n (CQ2 3.2)."""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.boundaries.condition import BoundaryCondition, register
from cqrun.numerics.tensor import dot, scale, sub
from cqrun.plugin.registry import plugin


class SlipKernel(NamedTuple):
    """Kernels' view."""

    normal: tuple[float, ...]
    coefficient: float


@plugin("boundary", "slip")
class Slip(BoundaryCondition):
    """A frictionless wall, from which bodies cannot separate: v - (v . n) n."""

    def kernel_condition(self, normal: Any) -> SlipKernel:
        return SlipKernel(normal, 0.0)


def slide(condition: Any, v: Any) -> Any:
    """Return v after the boundary."""
    return sub(v, scale(condition.normal, dot(v, condition.normal)))


def slide_vjp(condition: Any, v: Any, out_bar: Any) -> Any:
    """Return (v_bar, coefficient_bar): the projection is its own adjoint."""
    return sub(out_bar, scale(condition.normal, dot(out_bar, condition.normal))), 0.0


register(SlipKernel, slide, slide_vjp)
