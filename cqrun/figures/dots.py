"""Draw particles as dots that look like a solid body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from cqrun.figures.views import View
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import EllipseCollection

COVER = 1.5
"""Diameter of a dot divided by the distance between dots: the diagonal of a square lattice, and some stretch."""

COVER_3D = 1.25
"""The same in 3D, where dots have an edge; smaller, so that the shape of a body is visible."""

AROUND = {2: 16, 3: 40}
"""Number of nearest particles among which the neighbours in all directions are searched."""

ACROSS = 0.8
"""Sine of the smallest angle between two directions of neighbours."""

MOST = 6
"""Largest number of dots per particle along a direction in which particles are far apart."""

AROUND_RIM, ONE_SIDED = 20, 0.3
"""A dot is on the rim of a body if the mean direction to this number of nearest dots is at least this long."""

LINE, DARK = 0.7, 0.55
"""Width of the line around a body in 2D [points], and its brightness divided by that of the body."""

EVEN, MOSTLY = 0.1, 0.7
"""Particles are on a lattice if, for this share of them, the nearest distance equals that of the nearest particle."""


@dataclass(frozen=True)
class Dots:
    """Dots that fill bodies: one per particle, or several in a row on a lattice that is finer in one direction.

    Attributes:
        source: particle of each dot (M,).
        size: distance between dots at rest (M,) [m].
        beside: the neighbour of each particle in each direction (N, D); the particle itself if it has none.
        place: position of each dot between its particle and the neighbours (M, D), in parts of that distance.
        rim: the dots at the edges of bodies in 2D (K,); in 3D, where bodies have no line around them, none.
    """

    source: Array
    size: Array
    beside: Array
    place: Array
    rim: Array = field(default_factory=lambda: np.empty(0, int))

    @classmethod
    def of(cls, rest: Array, bodies: Mapping[str, slice]) -> Dots:
        """Return the dots of bodies with undeformed particles at `rest` (N, D)."""
        n, dim = rest.shape
        beside, counts = np.tile(np.arange(n)[:, None], dim), np.ones((n, dim), int)
        size = np.full(n, np.nan)
        for part in bodies.values():
            x_body = rest[part]
            if len(x_body) > 1:
                near, distance, size[part] = _neighbours(x_body)
                beside[part] = part.start + near
                counts[part] = distance
        known = size[np.nan_to_num(size) > 0]
        fallback = float(known.mean()) if known.size else 0.02 * max(float(np.abs(rest).max()), 1e-9)
        size = np.where(np.nan_to_num(size) > 0, size, fallback)
        source, place = _subdivided(counts)
        return cls(source, size[source], beside, place)._with_rim(rest, bodies)

    def positions(self, x: Array) -> Array:
        """Return the positions of the dots (M, D) for particles at x (N, D)."""
        out = x[self.source].copy()
        for axis in range(x.shape[1]):
            moved = np.flatnonzero(self.place[:, axis])
            source = self.source[moved]
            out[moved] += self.place[moved, axis, None] * (x[self.beside[source, axis]] - x[source])
        return np.asarray(out)

    def thinned(self, rest: Array, bodies: Mapping[str, slice], most: int) -> Dots:
        """Return these dots, or only every second, third, ... dot along every axis if there are more than `most`.

        Drawing every eighth dot of the sorted list would be simpler, but it could omit whole layers.

        Args:
            rest: positions of the undeformed particles (N, D).
            bodies: slice of each body's particles.
            most: largest number of dots.
        """
        at, step = self.positions(rest), max(1, int(np.ceil((len(self.source) / most) ** (1 / rest.shape[1]))) - 1)
        parts = [slice(*np.searchsorted(self.source, (part.start, part.stop))) for part in bodies.values()]
        kept = np.arange(len(at))
        while len(kept) > max(most, len(bodies)):
            step += 1
            kept = np.concatenate([part.start + _one_a_cell(at[part], self.size[part], step) for part in parts])
        if len(kept) == len(at):
            return self
        few = replace(self, source=self.source[kept], size=step * self.size[kept], place=self.place[kept])
        return few._with_rim(rest, bodies)

    def _with_rim(self, rest: Array, bodies: Mapping[str, slice]) -> Dots:
        """Return these dots with those on the rim of each body marked."""
        if rest.shape[1] == 3:
            return self
        at = self.positions(rest)
        parts = [np.arange(*np.searchsorted(self.source, (part.start, part.stop))) for part in bodies.values()]
        return replace(self, rim=np.concatenate([part[_one_sided(at[part])] for part in parts]))


def _one_sided(x: Array) -> Array:
    """Return which of a body's dots at (M, D) have most of their neighbours on one side: (M,) of bool."""
    from scipy.spatial import cKDTree

    if len(x) <= AROUND_RIM:
        return np.ones(len(x), bool)
    near = cKDTree(x).query(x, k=AROUND_RIM + 1)[1][:, 1:]
    arms = x[near] - x[:, None]
    directions = arms / np.maximum(np.sqrt(np.sum(arms**2, axis=2, keepdims=True)), 1e-300)
    return np.asarray(np.sqrt(np.sum(directions.mean(axis=1) ** 2, axis=1)) >= ONE_SIDED)


def _one_a_cell(at: Array, size: Array, step: int) -> Array:
    """Return the first dot in each cell of `step` dots along every axis (K,), for a body's dots at (M, D)."""
    if not len(at):
        return np.empty(0, int)
    place = (at - at.min(axis=0)) / np.median(
        size
    ) + 0.5  # in the middle of [k, k + 1), so that rounding does not matter
    return np.sort(np.unique(np.floor(place / step).astype(int), axis=0, return_index=True)[1])


def _neighbours(x: Array) -> tuple[Array, Array, Array]:
    """Return neighbours and number of dots of each particle in every direction (n, D), and the dots' distance (n,)."""
    from scipy.spatial import cKDTree

    n, dim = x.shape
    distance, near = cKDTree(x).query(x, k=min(AROUND[dim], n - 1) + 1)
    arms = x[near[:, 1:]] - x[:, None]
    beside, apart = np.tile(np.arange(n)[:, None], dim), np.full((n, dim), np.nan)
    rest = arms.copy()  # the part of each arm perpendicular to the directions found so far
    for axis in range(dim):
        across = np.sqrt(np.sum(rest**2, axis=2)) > ACROSS * np.maximum(distance[:, 1:], 1e-300)
        has_neighbour, first = across.any(axis=1), across.argmax(axis=1)
        rows = np.flatnonzero(has_neighbour)
        beside[rows, axis] = near[rows, 1 + first[rows]]
        apart[rows, axis] = distance[rows, 1 + first[rows]]
        direction = np.zeros((n, dim))
        direction[rows] = rest[rows, first[rows]] / np.sqrt(np.sum(rest[rows, first[rows]] ** 2, axis=1))[:, None]
        rest = rest - np.einsum("nki,ni->nk", rest, direction)[:, :, None] * direction[:, None]
    nearest = distance[:, 1]
    even = np.abs(nearest - nearest[near[:, 1]]) <= EVEN * nearest
    if even.mean() < MOSTLY or not (nearest > 0).all():  # not a lattice: dots as large as the gaps between particles
        return beside, np.ones((n, dim), int), distance[:, min(2 * dim, n - 1)]
    apart = np.where(np.isnan(apart), nearest[:, None], apart)
    counts = np.clip(np.round(apart / nearest[:, None]), 1, MOST).astype(int)
    return beside, counts, (apart / counts).max(axis=1)


def _subdivided(counts: Array) -> tuple[Array, Array]:
    """Return particle (M,) and place (M, D) of each dot, for the numbers of dots along each direction (N, D)."""
    sources, places = [], []
    for row in np.unique(counts, axis=0):
        particles = np.flatnonzero((counts == row).all(axis=1))
        steps = [(np.arange(k) + 0.5) / k - 0.5 for k in row]
        cell = np.stack([part.ravel() for part in np.meshgrid(*steps, indexing="ij")], axis=1)
        sources.append(np.repeat(particles, len(cell)))
        places.append(np.tile(cell, (len(particles), 1)))
    source, place = np.concatenate(sources), np.concatenate(places)
    order = np.argsort(source, kind="stable")
    return source[order], place[order]


def add_dots(axes: Axes, size: Array, *, cover: float = COVER, edge: float = 0.0) -> EllipseCollection:
    """Add dots to axes; `set_offsets` sets their positions.

    Args:
        axes: axes to draw in.
        size: distance between dots (M,), in the unit of the axes.
        cover: diameter of a dot divided by this distance.
        edge: width of the white line around a dot [points], which separates near dots from far ones.
    """
    from matplotlib.collections import EllipseCollection

    dots = EllipseCollection(
        cover * size, cover * size, np.zeros(len(size)), units="xy", offsets=np.zeros((len(size), 2)),
        offset_transform=axes.transData, rasterized=True, edgecolors="white", linewidths=edge,
    )  # fmt: skip
    axes.add_collection(dots)
    return dots


class OutlinedDots:
    """Dots of bodies in 2D with a darker line around each body, for one or several instants in one picture.

    The line is a second, larger dot below each dot on the rim.

    Args:
        axes: axes to draw in.
        dots: the dots.
        factor: a metre in the unit of the axes.
        layers: number of instants.

    Attributes:
        collection: what is added to the axes.
    """

    def __init__(self, axes: Axes, dots: Dots, factor: float, layers: int = 1) -> None:
        self._order, self._factor = np.concatenate([dots.rim, np.arange(len(dots.size))]), factor
        lines = np.repeat([2.0 * LINE, 0.0], [len(dots.rim), len(dots.size)])
        self._darkness = np.where(lines > 0.0, DARK, 1.0)[:, None]
        self.collection = add_dots(axes, factor * np.tile(dots.size[self._order], layers))
        self.collection.set_linewidth(np.tile(lines, layers).tolist())
        self.collection.set_edgecolor("face")

    def paint(self, layers: Sequence[tuple[Array, Array]]) -> None:
        """Show dots at x (M, 2) [m] with colours (M, 3) for each instant, the last on top."""
        self.collection.set_offsets(self._factor * np.concatenate([x[self._order] for x, _ in layers]))
        self.collection.set_facecolor(np.concatenate([self._darkness * rgb[self._order] for _, rgb in layers]))


def far_to_near(x: Array, look: View) -> Array:
    """Return the order in which to draw dots at x (M, D), so that near dots cover far ones."""
    return np.argsort(x @ look.towards, kind="stable")
