"""Strain of a region."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.explain import Loc
from cqrun.geometry.region import ChosenRegion
from cqrun.observers.matter import Matter
from cqrun.observers.observer import BoundObserver, Moment, MomentBar, Observer
from cqrun.observers.ranges import Range, limits
from cqrun.observers.rows import means
from cqrun.plugin.contract import Array, vector
from cqrun.plugin.reference import BodyName
from cqrun.plugin.registry import plugin


@plugin("observer", "strain")
class Strain(Observer):
    """Strain of a region, from the plain mean F of its particles' deformation gradients.

    Without `axis`: the components of the Green strain E = (F^T F - I) / 2, the diagonal first, then 01 (3D: 02, 12).
    With an axis n, at rest: the stretch |F n| - 1 along it. Both depend on the deformation alone, not on position or
    rotation, like a strain sensor glued into the body.
    """

    body: BodyName = Field(description="Body that is observed")
    region: ChosenRegion | None = Field(description="Region, at rest; the whole body if absent", default=None)
    axis: list[float] | None = vector(
        "1",
        "Direction at rest, scaled to length 1, of the observed stretch; if absent, all strain components",
        default=None,
    )
    range: Range = Field(description="Range that is scaled to [-1, 1]; auto: -1 to 1", default="auto")

    def dim_problems(self, dim: int) -> list[tuple[Loc, str]]:
        """Return what does not fit a world of `dim` dimensions."""
        problems = super().dim_problems(dim)
        if self.axis is not None and not np.any(self.axis):
            problems.append((("axis",), "must not be zero; give a direction, or leave it out for all components"))
        return problems

    def bind(self, matter: Matter) -> BoundObserver:
        chosen = matter.within(self.body, self.region)
        bound: GreenStrain | Stretch
        bound = GreenStrain(matter.dim) if self.axis is None else Stretch(np.array(self.axis))
        bound.rows = means([chosen], matter.n_particles)
        bound.low, bound.high = limits(self.range, np.full(bound.size, -1.0), np.full(bound.size, 1.0))
        return bound


class GreenStrain(BoundObserver):
    """Components of E = (F^T F - I) / 2."""

    def __init__(self, dim: int) -> None:
        i, j = np.triu_indices(dim, 1)
        self.i, self.j = np.concatenate([np.arange(dim), i]), np.concatenate([np.arange(dim), j])
        self.size = len(self.i)

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        F = moment.F[0]
        return (0.5 * (F.T @ F - np.eye(len(F))))[self.i, self.j], np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        F = moment.F[0]
        E_bar = np.zeros(F.shape)
        E_bar[self.i, self.j] = z_bar
        return MomentBar(F=0.5 * (F @ (E_bar + E_bar.T))[None])


class Stretch(BoundObserver):
    """|F n| - 1 for a unit direction n; its gradient is taken as 0 where F n vanishes."""

    size = 1

    def __init__(self, axis: Array) -> None:
        self.axis = axis / np.linalg.norm(axis)

    def observe(self, moment: Moment) -> tuple[Array, Array]:
        along = moment.F[0] @ self.axis
        return np.sqrt(np.sum(along * along, keepdims=True)) - 1.0, np.zeros(0)

    def observe_vjp(self, moment: Moment, z_bar: Array, memory_next_bar: Array) -> MomentBar:
        along = moment.F[0] @ self.axis
        length = np.sqrt(np.sum(along * along))
        along_bar = z_bar[0] * along / length if length > 0 else np.zeros(along.shape)
        return MomentBar(F=np.outer(along_bar, self.axis)[None])
