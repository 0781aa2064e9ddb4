"""Sticky: the node does not move, v = 0, in any direction (CQ1, boundary parameter -1)."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from cqrun.boundaries.condition import BoundaryCondition, register
from cqrun.numerics.tensor import scale
from cqrun.plugin.registry import plugin


class StickyKernel(NamedTuple):
    """Kernels' view."""

    normal: tuple[float, ...]
    coefficient: float


@plugin("boundary", "sticky")
class Sticky(BoundaryCondition):
    """Clamped nodes: v = 0 in all directions."""

    needs_normal: ClassVar[bool] = False

    def kernel_condition(self, normal: Any) -> StickyKernel:
        return StickyKernel(normal, 0.0)


def clamp(condition: Any, v: Any) -> Any:
    """Return v after the boundary."""
    return scale(v, 0.0)


def clamp_vjp(condition: Any, v: Any, out_bar: Any) -> Any:
    """Return (v_bar, coefficient_bar)."""
    return scale(out_bar, 0.0), 0.0


register(StickyKernel, clamp, clamp_vjp)
