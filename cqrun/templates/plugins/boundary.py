"""A boundary of your own: what it does to the velocity of grid nodes.

Here it is a floor on which bodies stick, and from which they can come off. Change `land` to your law, and `land_vjp` to
its adjoint: `cqrun gradcheck my_boundary.yaml --allow-plugins` checks that the two agree.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.boundaries.condition import BoundaryCondition, register
from cqrun.numerics.tensor import dot, scale
from cqrun.plugin.registry import plugin


class MyBoundaryKernel(NamedTuple):
    """What kernels see."""

    normal: tuple[float, ...]
    coefficient: float


@plugin("boundary", "my_boundary")
class MyBoundary(BoundaryCondition):
    """A floor on which bodies stick, and from which they can come off: v is zero unless v . n > 0.

    This text is the page of the boundary: `cqrun describe boundary my_boundary --plugin my_boundary.py`.
    """

    def kernel_condition(self, normal: Any) -> MyBoundaryKernel:
        """Return what kernels see, for a unit normal that points into the free side."""
        return MyBoundaryKernel(normal, 0.0)


def land(condition: Any, v: Any) -> Any:
    """Return v after the boundary."""
    return v if dot(v, condition.normal) > 0.0 else scale(v, 0.0)


def land_vjp(condition: Any, v: Any, out_bar: Any) -> Any:
    """Return (v_bar, coefficient_bar)."""
    return (out_bar if dot(v, condition.normal) > 0.0 else scale(out_bar, 0.0)), 0.0


register(MyBoundaryKernel, land, land_vjp)
