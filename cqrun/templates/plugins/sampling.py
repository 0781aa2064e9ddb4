"""Bricks: a sampling of your own. A sampling fills a shape with particles."""

from __future__ import annotations

import numpy as np

from cqrun.geometry.sampling import Sampling
from cqrun.geometry.shape import Shape, cell_centres, finite_bounds
from cqrun.plugin.contract import Array, quantity
from cqrun.plugin.registry import plugin


@plugin("sampling", "my_sampling")
class MySampling(Sampling):
    """A lattice whose rows are shifted along x in turn, like bricks.

    This text is the page of the sampling: `cqrun describe sampling my_sampling --plugin my_sampling.py`.
    """

    shift: float = quantity("1", "Shift of every second row, in spacings", ge=0, lt=1, default=0.5)

    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        """Return positions (N, D) [m] and volumes (N,) [m^3; 2D: m^2] of particles at a distance of `spacing` [m]."""
        assert spacing is not None
        lower, upper = finite_bounds(shape)
        counts = np.ceil((upper - lower) / spacing * (1 - 1e-12)).astype(int) + 1
        start = lower - spacing * np.eye(len(lower))[0]  # one cell more, for the rows that are shifted
        points = cell_centres(start, np.full(len(lower), spacing), counts)
        row = np.round((points[:, 1] - lower[1]) / spacing - 0.5).astype(int)
        points[:, 0] += self.shift * spacing * (row % 2)
        points = points[shape.inside(points)]
        return points, np.full(len(points), spacing ** points.shape[1])
