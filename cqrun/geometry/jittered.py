"""Particles on a lattice, each moved randomly within its cell."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.geometry.sampling import Sampling
from cqrun.geometry.shape import Shape, lattice_points
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("sampling", "jittered")
class Jittered(Sampling):
    """A lattice whose particles are moved randomly by up to amount/2 spacings along every axis; volume spacing^D."""

    amount: float = quantity("1", "Range of the random moves, in spacings", ge=0, le=1, default=0.5)
    seed: int = Field(description="Seed of the moves", ge=0, default=0)

    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        assert spacing is not None
        points = lattice_points(shape, spacing)
        reach = 0.5 * self.amount * spacing
        moves = np.random.default_rng(self.seed).uniform(-reach, reach, points.shape)
        return points + moves, np.full(len(points), spacing ** points.shape[1])
