"""Sticky: the node does not move, v = 0, in any direction (CQ1, boundary parameter -1).

In the reference frame it may carry its nodes to another place (engine/reference/moves.py).
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from pydantic import Field

from cqrun.boundaries.condition import BoundaryCondition, register
from cqrun.explain import Loc
from cqrun.numerics.tensor import scale
from cqrun.plugin.contract import quantity, vector
from cqrun.plugin.reference import RigidName
from cqrun.plugin.registry import plugin


class StickyKernel(NamedTuple):
    """Kernels' view."""

    normal: tuple[float, ...]
    coefficient: float


@plugin("boundary", "sticky")
class Sticky(BoundaryCondition):
    """Clamped nodes: v = 0 in all directions."""

    needs_normal: ClassVar[bool] = False
    displacement: list[float] | None = vector(
        "m", "Displacement to which it carries its nodes, in the reference frame", differentiable=True, default=None,
        exclude_if=lambda value: value is None,
    )  # fmt: skip
    rotation: list[float] | None = quantity(
        "rad", "Rotation to which it carries its nodes: an angle in 2D, a rotation vector in 3D", differentiable=True,
        default=None, min_length=1, max_length=3, exclude_if=lambda value: value is None,
    )  # fmt: skip
    center: list[float] | None = vector(
        "m", "Centre of the rotation and of the moment, at rest; that of the held material if absent", default=None,
        exclude_if=lambda value: value is None,
    )  # fmt: skip
    over: float | None = quantity(
        "s", "Time in which it gets there, at constant speed; the whole run if absent", gt=0, default=None,
        exclude_if=lambda value: value is None,
    )  # fmt: skip

    to: RigidName | None = Field(
        description="Rigid body, fixed or on a path, to which it glues what it holds, in place of a motion of its own",
        default=None, exclude_if=lambda value: value is None,
    )  # fmt: skip

    @property
    def moves(self) -> bool:
        """Whether it carries its nodes anywhere."""
        return self.displacement is not None or self.rotation is not None or self.to is not None

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions, and fields without a use."""
        problems, turns = super().dim_problems(dim), 1 if dim == 2 else 3
        if self.rotation is not None and len(self.rotation) != turns:
            problems.append(
                (("rotation",), f"must have {turns} entries in this {dim}D world, has {len(self.rotation)}")
            )
        if self.to is not None:
            own = [name for name in ("displacement", "rotation", "center", "over") if getattr(self, name) is not None]
            problems += [((name,), f"has no effect: the rigid body '{self.to}' carries it; remove it") for name in own]
        if self.over is not None and not self.moves:
            problems.append((("over",), "has no effect without `displacement or rotation`: give one, or remove it"))
        return problems

    def carried_to(self, dim: int) -> list[float]:
        """Return displacement and rotation in one list, of zeros where they are absent."""
        turns = 1 if dim == 2 else 3
        return [*(self.displacement or [0.0] * dim), *(self.rotation or [0.0] * turns)]

    def kernel_condition(self, normal: Any) -> StickyKernel:
        return StickyKernel(normal, 0.0)


def clamp(condition: Any, v: Any) -> Any:
    """Return v after the boundary."""
    return scale(v, 0.0)


def clamp_vjp(condition: Any, v: Any, out_bar: Any) -> Any:
    """Return (v_bar, coefficient_bar)."""
    return scale(out_bar, 0.0), 0.0


register(StickyKernel, clamp, clamp_vjp)
