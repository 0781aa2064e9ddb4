"""Separate: nothing moves into the surface, everything may leave it, no friction (CQ2 3.2)."""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.boundaries.condition import BoundaryCondition, register
from cqrun.numerics.tensor import dot, scale, sub
from cqrun.plugin.registry import plugin


class SeparateKernel(NamedTuple):
    """What kernels see."""

    normal: tuple[float, ...]
    coefficient: float


@plugin("boundary", "separate")
class Separate(BoundaryCondition):
    """A frictionless wall that lets go: v - min(v . n, 0) n."""

    def kernel_condition(self, normal: Any) -> SeparateKernel:
        return SeparateKernel(normal, 0.0)


def stop(condition: Any, v: Any) -> Any:
    """Return v after the boundary."""
    into = dot(v, condition.normal)
    return v if into >= 0.0 else sub(v, scale(condition.normal, into))


def stop_vjp(condition: Any, v: Any, out_bar: Any) -> Any:
    """Return (v_bar, coefficient_bar)."""
    if dot(v, condition.normal) >= 0.0:
        return out_bar, 0.0
    return sub(out_bar, scale(condition.normal, dot(out_bar, condition.normal))), 0.0


register(SeparateKernel, stop, stop_vjp)
