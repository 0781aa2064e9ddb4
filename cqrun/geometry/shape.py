"""Base of shapes: a shape is a closed set of points with bounds and a volume."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated, Self

import numpy as np

from cqrun.errors import UsageError
from cqrun.geometry.region import Points, Region
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array

_COUNTING_CELLS = 2_000_000
"""Approximate number of cells for a volume without a formula; the error is about 1e-4 of the bounds' volume."""

SLACK = 1e-9
"""Relative tolerance, so that a grid node on a face is inside in spite of rounding, as in 0.1 + 0.2. It is relative to
the shape's size or to the position of its face."""

MAX_POINTS = 20_000_000
"""Largest number of lattice points; more are a mistake in the spacing."""


class Shape(Region):
    """A region of space, in world coordinates at the start (material coordinates)."""

    def pick(self, points: Points) -> Array:
        return self.inside(points.x)

    def distance(self, points: Array) -> tuple[Array, Array] | None:
        """Return what a shape knows about its surface: distances of points (n, D) [m] and normals (n, D) next to them.

        Distances are negative inside. None if the shape knows no more than which points are inside.
        """
        return None

    @abstractmethod
    def inside(self, points: Array) -> Array:
        """Return which points (N, D) [m] are in the shape or on its surface: (N,) bool."""

    @abstractmethod
    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and upper corner (D,) [m] of an axis-aligned box around the shape."""

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        """Return the positions of points (N, D) [m] of this shape as it becomes `to`, and their volumes' growth (N,).

        The map is continuous, piecewise smooth, and the identity if nothing changes. `to` is the same kind of shape
        with other numbers; they may be complex, for a derivative by complex step.
        """
        return points, np.ones(len(points))

    @property
    def colour_names(self) -> tuple[str, ...]:
        """The names of the colours of an image inside the shape; each is a group of its body."""
        return ()

    def coloured(self, points: Array, colour: str) -> Array:
        """Return which points (N, D) [m] lie in pixels of a colour, by its name or `#rrggbb`: (N,) bool.

        Raises:
            UsageError: none of its images has the colour.
        """
        return np.zeros(len(points), bool)

    @property
    def has_colours(self) -> bool:
        """Whether it has colours from an image."""
        return type(self).coloured is not Shape.coloured

    def volume(self) -> float:
        """Return the volume [m^3] (2D: area [m^2]), counted on a fine lattice if there is no formula."""
        return counted_volume(self)


ChosenShape = Annotated[Chosen[Shape], Choice("shape")]
"""Type of a field that holds any shape."""


def coloured_parts(parts: Sequence[Shape], points: Array, colour: str) -> list[Array]:
    """Return which points (N, D) [m] lie in pixels of a colour, for each of several shapes: (N,) bool each.

    A name is looked up only in shapes that define it. For `#rrggbb`, some of the images may have no such pixel.

    Raises:
        UsageError: there are images, and none of them has the colour.
    """
    named = any(colour in part.colour_names for part in parts)
    candidates = [part for part in parts if (colour in part.colour_names if named else part.has_colours)]
    masks: dict[int, Array] = {}
    errors: list[UsageError] = []
    for part in candidates:
        try:
            masks[id(part)] = part.coloured(points, colour)
        except UsageError as error:
            errors.append(error)
    if errors and not masks:
        raise errors[0]
    return [masks.get(id(part), np.zeros(len(points), bool)) for part in parts]


def slack_at(points: Array) -> Array:
    """Return the tolerance (N,) [m] at points (N, D) [m] for faces of infinite size."""
    return np.asarray(SLACK * np.linalg.norm(points, axis=1))


def counted_volume(shape: Shape, cells: int = _COUNTING_CELLS) -> float:
    """Return a shape's volume [m^D], counted on a lattice of about `cells` cells over its bounds."""
    lower, upper = finite_bounds(shape)
    size = upper - lower
    spacing = float(np.prod(size) / cells) ** (1 / len(size))
    # multiples of 4, so that faces on the bounds and halfway lie between cells
    counts = 4 * np.ceil(size / (4 * spacing)).astype(int)
    return float(shape.inside(cell_centres(lower, size / counts, counts)).mean() * np.prod(size))


def lattice_points(shape: Shape, spacing: float) -> Array:
    """Return the points (N, D) [m] at (k + 1/2) * spacing from the lower corner that lie in the shape.

    Raises:
        UsageError: the shape is unbounded, or the lattice is far too fine for it.
    """
    corner, counts = lattice_around(shape, spacing)
    points = cell_centres(corner, np.full(len(corner), spacing), counts)
    return points[shape.inside(points)]


def lattice_around(shape: Shape, spacing: float, *, centered: bool = False) -> tuple[Array, Array]:
    """Return the lower corner (D,) [m] and the counts (D,) of the cells of a lattice that covers a shape.

    Args:
        shape: what to fill.
        spacing: edge of a cell [m].
        centered: whether the lattice is symmetric about the middle of the bounds; else it begins at their lower corner.

    Raises:
        UsageError: the shape is unbounded, or the lattice is far too fine for it.
    """
    lower, upper = finite_bounds(shape)
    counts = np.ceil((upper - lower) / spacing * (1 - 1e-12))  # without a last cell that only rounding would add
    if np.prod(counts) > MAX_POINTS:
        raise UsageError(
            f"a spacing of {spacing:g} m puts {np.prod(counts):.3g} lattice points around the {shape.name}; "
            f"at most {MAX_POINTS:.0e} are allowed: check the units of spacing, dx and the shape"
        )
    corner = 0.5 * (lower + upper - counts * spacing) if centered else lower
    return corner, counts.astype(int)


def cell_centres(lower: Array, spacing: Array, counts: Array) -> Array:
    """Return the centres (prod(counts), D) [m] of `counts` (D,) cells of size `spacing` (D,) from a corner."""
    axes = [low + (np.arange(n) + 0.5) * h for low, h, n in zip(lower, spacing, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(lower))


def finite_bounds(shape: Shape) -> tuple[Array, Array]:
    """Return the bounds of a shape that can be filled; UsageError if it is infinite or empty."""
    lower, upper = shape.bounds()
    if not (np.isfinite(lower).all() and np.isfinite(upper).all()):
        raise UsageError(f"the {shape.name} is infinite; intersect it with a box to fill it with particles")
    if (upper <= lower).any():
        raise UsageError(f"the {shape.name} is empty: its parts do not meet")
    return lower, upper
