"""Particles at random places."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.geometry.sampling import Sampling
from cqrun.geometry.shape import MAX_POINTS, Shape, finite_bounds
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

_BATCH = 4096


@plugin("sampling", "random")
class Random(Sampling):
    """`count` independent particles with uniform density in the shape; volume: the shape's divided by count."""

    count: int = Field(description="Number of particles", ge=1, le=MAX_POINTS)
    seed: int = Field(description="Seed of the random places", ge=0, default=0)

    @property
    def needs_spacing(self) -> bool:
        return False

    def estimate(self, shape: Shape, spacing: float | None) -> float:
        return float(self.count)

    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        lower, upper = finite_bounds(shape)
        rng = np.random.default_rng(self.seed)
        inside: list[Array] = []
        n_inside, tried = 0, 0
        while n_inside < self.count:
            trial = rng.uniform(lower, upper, (_BATCH, len(lower)))
            inside.append(trial[shape.inside(trial)])
            n_inside, tried = n_inside + len(inside[-1]), tried + _BATCH
            if n_inside < 1e-5 * tried and tried >= 1_000_000:
                raise UsageError(f"the {shape.name} fills less than 1e-5 of its bounds; is it empty?")
        points = np.concatenate(inside)[: self.count]
        return points, np.full(self.count, shape.volume() / self.count)
