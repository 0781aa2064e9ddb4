"""Particles on a regular lattice."""

from __future__ import annotations

from math import ceil
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from cqrun.errors import UsageError
from cqrun.explain import complaint, finding
from cqrun.geometry.sampling import Sampling
from cqrun.geometry.shape import MAX_POINTS, Shape, cell_centres, finite_bounds, lattice_points
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
    """

    count: int | None = Field(description="Number of cells along every axis, instead of a spacing", ge=1, default=None)
    centered: bool = Field(
        description="Whether the lattice is symmetric about the middle of the shape's bounds", default=False,
        exclude_if=lambda centered: not centered,  # so that scenes without it keep the names of their runs
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

    def estimate(self, shape: Shape, spacing: float | None) -> float:
        dim = len(shape.bounds()[0])
        return super().estimate(shape, spacing) if self.count is None else float(self.count) ** dim

    def sample(self, shape: Shape, spacing: float | None) -> tuple[Array, Array]:
        if self.count is None:
            assert spacing is not None
            points = lattice_points(shape, spacing, centered=self.centered)
            return points, np.full(len(points), spacing ** points.shape[1])
        lower, upper = finite_bounds(shape)
        dim = len(lower)
        if self.count**dim > MAX_POINTS:
            raise UsageError(f"a count of {self.count} makes {self.count**dim:.3g} cells, more than {MAX_POINTS:.0e}")
        size = (upper - lower) / self.count
        points = cell_centres(lower, size, np.full(dim, self.count))
        points = points[shape.inside(points)]
        return points, np.full(len(points), np.prod(size))


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
