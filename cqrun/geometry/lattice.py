"""Particles on a regular lattice."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.geometry.sampling import Sampling
from cqrun.geometry.shape import MAX_POINTS, Shape, cell_centres, finite_bounds, lattice_points
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("sampling", "lattice")
class Lattice(Sampling):
    """A particle at (k + 1/2) * spacing from the shape's lower corner, k whole; volume spacing^D each.

    With `count`: n^D cells of equal size over the bounds of the shape, or of each part, a particle in the middle
    of every cell whose middle the shape holds, with the cell's volume. Parts of different size then have equally
    many particles, as the robots of CQ1 do.
    """

    count: int | None = Field(description="Cells along every axis, instead of a spacing", ge=1, default=None)

    @property
    def needs_spacing(self) -> bool:
        return self.count is None

    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        if self.count is None:
            assert spacing is not None
            points = lattice_points(shape, spacing)
            return points, np.full(len(points), spacing ** points.shape[1])
        lower, upper = finite_bounds(shape)
        dim = len(lower)
        if self.count**dim > MAX_POINTS:
            raise UsageError(f"a count of {self.count} makes {self.count**dim:.3g} cells; at most {MAX_POINTS:.0e} are")
        size = (upper - lower) / self.count
        points = cell_centres(lower, size, np.full(dim, self.count))
        points = points[shape.inside(points)]
        return points, np.full(len(points), np.prod(size))
