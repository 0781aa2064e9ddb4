"""Separate: no motion into the surface, free motion away from it and along it (CQ2 3.2)."""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.boundaries.condition import register
from cqrun.boundaries.obstacle import Obstacle
from cqrun.numerics.tensor import dot, scale, sub
from cqrun.plugin.registry import plugin


class SeparateKernel(NamedTuple):
    """Kernels' view."""

    normal: tuple[float, ...]
    coefficient: float


@plugin("boundary", "separate")
class Separate(Obstacle):
    """A frictionless wall, from which bodies can separate: v - min(v . n, 0) n."""

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
