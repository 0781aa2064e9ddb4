"""Particles on a regular lattice."""

from __future__ import annotations

from math import ceil
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import complaint, finding
from cqrun.geometry.fitted import fit
from cqrun.geometry.sampling import Sampling
from cqrun.geometry.shape import MAX_POINTS, Shape, cell_centres, finite_bounds, lattice_around
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin


@plugin("sampling", "lattice")
class Lattice(Sampling):
    """Particles at (k + 1/2) * spacing from the shape's lower corner, k an integer; volume spacing^D each.

    With `count` there are count^D cells of equal size over the bounds of the shape, or of each part, and a particle in
    every cell whose centre is in the shape, with the cell's volume. So parts of different sizes have the same number of
    particles, as in the robots of CQ1.

    With `centered` the lattice is symmetric about the middle of the shape's bounds. A tapered or round body whose size
    is no multiple of the spacing is lopsided otherwise, because the lattice begins at its lower corner.

    With `fitted` each particle has the volume and the centre of the part of the shape that is nearest to it. Use it for
    walls and for round or tapered bodies that are a few cells thick. Under an inner pressure, a ring of 4 cells widens
    by 8 % too much without it, and by 3 % with it. Volumes sum to that of the shape, to at most 1/32 of a spacing at
    flat faces. It changes nothing in a box of whole cells. It can be combined with `centered` and with `count`. If the
    shape has unknowns, particles are fitted at the values in the scene, and then follow the shape as all particles do.
    """

    count: int | None = Field(description="Number of cells along every axis, instead of a spacing", ge=1, default=None)
    centered: bool = Field(
        description="Whether the lattice is symmetric about the middle of the shape's bounds", default=False,
        exclude_if=lambda centered: not centered,  # so that scenes without it keep the names of their runs
    )  # fmt: skip
    fitted: bool = Field(
        description="Whether particles have the volume and the centre of their parts of the shape", default=False,
        exclude_if=lambda fitted: not fitted,
    )  # fmt: skip

    @model_validator(mode="after")
    def _one_placement(self) -> Self:
        if self.count is not None and self.centered:
            message = "has no effect with a count, whose cells fill the bounds evenly: remove one of the two"
            raise complaint("Lattice", [finding(message, ("centered",), involves=("count",))])
        return self

    @property
    def needs_spacing(self) -> bool:
        return self.count is None

    @property
    def is_lattice(self) -> bool:
        return self.count is None

    def estimate(self, shape: Shape, spacing: float | None) -> float:
        dim = len(shape.bounds()[0])
        return super().estimate(shape, spacing) if self.count is None else float(self.count) ** dim

    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        corner, size, counts = self._cells(shape, spacing)
        if self.fitted:
            return fit(shape, corner, size, counts)
        points = cell_centres(corner, size, counts)
        points = points[shape.inside(points)]
        volume = float(size[0]) ** len(size) if self.count is None else float(np.prod(size))
        return points, np.full(len(points), volume)

    def _cells(self, shape: Shape, spacing: float | None) -> tuple[Array, Array, Array]:
        """Return the lower corner (D,) [m], the size (D,) [m] and the counts (D,) of the lattice's cells."""
        if self.count is None:
            assert spacing is not None
            corner, counts = lattice_around(shape, spacing, centered=self.centered)
            return corner, np.full(len(corner), spacing), counts
        lower, upper = finite_bounds(shape)
        dim = len(lower)
        if self.count**dim > MAX_POINTS:
            raise UsageError(f"a count of {self.count} makes {self.count**dim:.3g} cells, more than {MAX_POINTS:.0e}")
        return lower, (upper - lower) / self.count, np.full(dim, self.count)


WHOLE = 1e-3
"""An edge is a multiple of a spacing to this part of the spacing."""


def whole_spacing(size: Array, about: float, factor: float = 1.0, within: float = 1.4) -> float | None:
    """Return the spacing near another of which every edge of a box is a multiple [m]; None if there is none.

    Args:
        size: edges of the box (D,) [m].
        about: the other spacing [m].
        factor: multiple of the spacing, such as the edge of a cell, which should have few digits.
        within: ratio of the two spacings, at most.
    """
    least = float(np.min(size))
    most = range(max(1, ceil(least / (about * within))), int(least * within / about) + 1)
    spacings = [least / n for n in most]
    whole = [s for s in spacings if np.all(np.abs(size / s - np.round(size / s)) < WHOLE)]
    return min(whole, key=lambda s: (_digits(factor * s), abs(np.log(s / about))), default=None)


def _digits(number: float) -> int:
    """Return the number of digits of a number, up to six."""
    return len(f"{number:.5e}".split("e")[0].rstrip("0").replace(".", ""))
