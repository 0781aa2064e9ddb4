"""Coulomb friction with separation (CQ1 supplement XI, CQ2 appendix B).

    l_n = v . n,  v_t = v - l_n n,  l_t = sqrt(|v_t|^2 + eps)
    v* = max(l_t + c min(l_n, 0), 0) v_t / l_t + max(l_n, 0) n

A node that is pressed into the surface (l_n < 0) loses c |l_n| of its tangential speed; it sticks if it loses all.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.boundaries.condition import register
from cqrun.boundaries.obstacle import Obstacle
from cqrun.numerics.tensor import add, dot, scale, sub
from cqrun.plugin.contract import quantity
from cqrun.plugin.registry import plugin

SMOOTHING = 1e-7
"""eps [(m/s)^2] of both papers: keeps v_t / l_t defined at rest."""


class FrictionKernel(NamedTuple):
    """Kernels' view."""

    normal: tuple[float, ...]
    coefficient: float


@plugin("boundary", "friction")
class Friction(Obstacle):
    """A wall with Coulomb friction, from which bodies can separate; coefficient 0 is `separate`."""

    coefficient: float = quantity("1", "Coulomb friction coefficient", differentiable=True, ge=0)

    def kernel_condition(self, normal: Any) -> FrictionKernel:
        return FrictionKernel(normal, self.coefficient)


def rub(condition: Any, v: Any) -> Any:
    """Return v after the boundary."""
    n = condition.normal
    l_n = dot(v, n)
    v_t = sub(v, scale(n, l_n))
    l_t = np.sqrt(dot(v_t, v_t) + SMOOTHING)
    left = max(l_t + condition.coefficient * min(l_n, 0.0), 0.0)
    return add(scale(v_t, left / l_t), scale(n, max(l_n, 0.0)))


def rub_vjp(condition: Any, v: Any, out_bar: Any) -> Any:
    """Return (v_bar, coefficient_bar)."""
    n, c = condition.normal, condition.coefficient
    l_n = dot(v, n)
    v_t = sub(v, scale(n, l_n))
    l_t = np.sqrt(dot(v_t, v_t) + SMOOTHING)
    pressed = min(l_n, 0.0)
    slides = 1.0 if l_t + c * pressed >= 0.0 else 0.0
    left = slides * (l_t + c * pressed)
    ratio_bar = dot(out_bar, v_t)
    left_bar = slides * ratio_bar / l_t
    l_t_bar = left_bar - ratio_bar * left / (l_t * l_t)
    v_t_bar = add(scale(out_bar, left / l_t), scale(v_t, l_t_bar / l_t))
    l_n_bar = dot(out_bar, n) if l_n >= 0.0 else left_bar * c
    return add(v_t_bar, scale(n, l_n_bar - dot(v_t_bar, n))), left_bar * pressed


register(FrictionKernel, rub, rub_vjp)
