"""A union of shapes, optionally scaled and moved as one."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree

from cqrun.boundaries.solid import Solid
from cqrun.geometry.shape import ChosenShape, Shape, coloured_parts
from cqrun.plugin.contract import Array, quantity, vector
from cqrun.plugin.registry import plugin


@plugin("shape", "union")
class Union(Shape):
    """The points that any of its shapes contains: `union: [shape, ...]`.

    `union: {shapes: [...], scale: 0.2, offset: [...]}` gives the shapes in local units: world = scale * local + offset.
    Overlaps are filled once, as one lattice fills the whole union.
    """

    shorthand: ClassVar[str] = "shapes"

    shapes: list[ChosenShape] = Field(description="Shapes, in local coordinates", min_length=1)
    scale: float = quantity("1", "World length of one unit of local length", gt=0, geometric=True, default=1.0)
    offset: list[float] | None = vector("m", "World position of the local origin", geometric=True, default=None)

    def inside(self, points: Array) -> Array:
        local = (points - self._origin()) / self.scale
        return np.any([part.value.inside(local) for part in self.shapes], axis=0)

    @property
    def colour_names(self) -> tuple[str, ...]:
        return tuple(name for part in self.shapes for name in part.value.colour_names)

    @property
    def has_colours(self) -> bool:
        return any(part.value.has_colours for part in self.shapes)

    def coloured(self, points: Array, colour: str) -> Array:
        local = (points - self._origin()) / self.scale
        return np.any(coloured_parts([part.value for part in self.shapes], local, colour), axis=0)

    def bounds(self) -> tuple[Array, Array]:
        lower, upper = zip(*(part.value.bounds() for part in self.shapes), strict=True)
        origin = self._origin()
        return self.scale * np.min(lower, axis=0) + origin, self.scale * np.max(upper, axis=0) + origin

    def carried(self, points: Array, to: Self) -> tuple[Array, Array]:
        """Move each point with the first of the shapes that contains it."""
        local = (points - self._origin()) / self.scale
        owner, order, carried = self._owners(local), [], []
        for k, (part, part_to) in enumerate(zip(self.shapes, to.shapes, strict=True)):
            indices = np.flatnonzero(owner == k)
            order.append(indices)
            carried.append(part.value.carried(local[indices], part_to.value))
        back = np.argsort(np.concatenate(order))
        moved, growth = (np.concatenate(each)[back] for each in zip(*carried, strict=True))
        return to._origin() + to.scale * moved, growth * (to.scale / self.scale) ** points.shape[1]

    def solids(self) -> list[Solid]:
        solids = [solid for part in self.shapes for solid in part.value.solids()]
        dim = len(self.bounds()[0])
        return [solid.placed(self.scale, np.eye(dim), np.zeros(dim) + self._origin()) for solid in solids]

    def _owners(self, local: Array) -> Array:
        """Return the index of the shape that moves each point (N,): the first that contains it.

        A point outside all shapes, such as a jittered one beside a surface, moves with the nearest point inside.
        """
        contained = np.array([part.value.inside(local) for part in self.shapes])
        owner, stray = contained.argmax(axis=0), ~contained.any(axis=0)
        if stray.any() and not stray.all():
            _, nearest = cKDTree(local[~stray]).query(local[stray])
            owner[stray] = owner[~stray][nearest]
        return np.asarray(owner)

    def _origin(self) -> Array | float:
        return 0.0 if self.offset is None else np.array(self.offset)
