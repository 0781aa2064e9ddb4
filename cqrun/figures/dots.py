"""Particles as dots that look like a solid body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cqrun.figures.views import View
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import EllipseCollection

COVER = 1.5
"""Diameter of a dot in distances between dots: the diagonal of a square lattice, and some stretch."""

COVER_3D = 1.25
"""The same in three dimensions, where dots have an edge: smaller, so that what lies behind shows its form."""

AROUND = {2: 16, 3: 40}
"""Nearest particles among which those beside a particle are looked for, in every direction."""

ACROSS = 0.8
"""Sine of the angle at which a neighbour begins to lie in another direction."""

MOST = 6
"""Dots for one particle along a direction in which particles lie far apart."""

EVEN, MOSTLY = 0.1, 0.7
"""On a lattice the distance to the nearest is the same as for that one, to this part, for most particles."""


@dataclass(frozen=True)
class Dots:
    """Dots that fill bodies: one a particle or, on a lattice that is finer along one direction, some in a row.

    Attributes:
        source: particle of each dot (M,).
        size: distance between dots at rest (M,) [m].
        beside: the particle beside each, in each direction (N, D); itself where there is none.
        place: of each dot between its particle and those beside it (M, D), in parts of that distance.
    """

    source: Array
    size: Array
    beside: Array
    place: Array

    @classmethod
    def of(cls, rest: Array, bodies: Mapping[str, slice]) -> Dots:
        """Return the dots of bodies whose undeformed particles are at rest (N, D)."""
        n, dim = rest.shape
        beside, counts = np.tile(np.arange(n)[:, None], dim), np.ones((n, dim), int)
        size = np.full(n, np.nan)
        for part in bodies.values():
            own = rest[part]
            if len(own) > 1:
                near, distance, size[part] = _neighbours(own)
                beside[part] = part.start + near
                counts[part] = distance
        known = size[np.nan_to_num(size) > 0]
        fallback = float(known.mean()) if known.size else 0.02 * max(float(np.abs(rest).max()), 1e-9)
        size = np.where(np.nan_to_num(size) > 0, size, fallback)
        source, place = _subdivided(counts)
        return cls(source, size[source], beside, place)

    def positions(self, x: Array) -> Array:
        """Return where the dots are (M, D) with the particles at x (N, D)."""
        out = x[self.source].copy()
        for axis in range(x.shape[1]):
            moved = np.flatnonzero(self.place[:, axis])
            own = self.source[moved]
            out[moved] += self.place[moved, axis, None] * (x[self.beside[own, axis]] - x[own])
        return np.asarray(out)

    def thinned(self, rest: Array, bodies: Mapping[str, slice], most: int) -> Dots:
        """Return these dots, or where they are more than `most`, every second one, third one, ... along every axis.

        Of dots from far to near every eighth would be drawn sooner, but those may be whole layers.

        Args:
            rest: undeformed particles (N, D).
        """
        at, step = self.positions(rest), max(1, int(np.ceil((len(self.source) / most) ** (1 / rest.shape[1]))) - 1)
        parts = [slice(*np.searchsorted(self.source, (part.start, part.stop))) for part in bodies.values()]
        kept = np.arange(len(at))
        while len(kept) > max(most, len(bodies)):
            step += 1
            kept = np.concatenate([part.start + _one_a_cell(at[part], self.size[part], step) for part in parts])
        if len(kept) == len(at):
            return self
        return replace(self, source=self.source[kept], size=step * self.size[kept], place=self.place[kept])


def _one_a_cell(at: Array, size: Array, step: int) -> Array:
    """Return the first dot of each cell of so many along every axis (K,), of a body's dots at (M, D)."""
    if not len(at):
        return np.empty(0, int)
    place = (at - at.min(axis=0)) / np.median(size) + 0.5  # in the middle of [k, k + 1), however it is rounded
    return np.sort(np.unique(np.floor(place / step).astype(int), axis=0, return_index=True)[1])


def _neighbours(own: Array) -> tuple[Array, Array, Array]:
    """Return the particle beside each in every direction (n, D), dots along it (n, D) and their distance (n,)."""
    from scipy.spatial import cKDTree

    n, dim = own.shape
    distance, near = cKDTree(own).query(own, k=min(AROUND[dim], n - 1) + 1)
    arms = own[near[:, 1:]] - own[:, None]
    beside, apart = np.tile(np.arange(n)[:, None], dim), np.full((n, dim), np.nan)
    rest = arms.copy()  # what is left of each arm across the directions found so far
    for axis in range(dim):
        across = np.sqrt(np.sum(rest**2, axis=2)) > ACROSS * np.maximum(distance[:, 1:], 1e-300)
        found, first = across.any(axis=1), across.argmax(axis=1)
        rows = np.flatnonzero(found)
        beside[rows, axis] = near[rows, 1 + first[rows]]
        apart[rows, axis] = distance[rows, 1 + first[rows]]
        direction = np.zeros((n, dim))
        direction[rows] = rest[rows, first[rows]] / np.sqrt(np.sum(rest[rows, first[rows]] ** 2, axis=1))[:, None]
        rest = rest - np.einsum("nki,ni->nk", rest, direction)[:, :, None] * direction[:, None]
    nearest = distance[:, 1]
    even = np.abs(nearest - nearest[near[:, 1]]) <= EVEN * nearest
    if even.mean() < MOSTLY or not (nearest > 0).all():  # no lattice: a dot as large as the gaps between particles
        return beside, np.ones((n, dim), int), distance[:, min(2 * dim, n - 1)]
    apart = np.where(np.isnan(apart), nearest[:, None], apart)
    counts = np.clip(np.round(apart / nearest[:, None]), 1, MOST).astype(int)
    return beside, counts, (apart / counts).max(axis=1)


def _subdivided(counts: Array) -> tuple[Array, Array]:
    """Return particle (M,) and place (M, D) of each dot, for numbers of dots along each direction (N, D)."""
    sources, places = [], []
    for row in np.unique(counts, axis=0):
        own = np.flatnonzero((counts == row).all(axis=1))
        steps = [(np.arange(k) + 0.5) / k - 0.5 for k in row]
        cell = np.stack([part.ravel() for part in np.meshgrid(*steps, indexing="ij")], axis=1)
        sources.append(np.repeat(own, len(cell)))
        places.append(np.tile(cell, (len(own), 1)))
    source, place = np.concatenate(sources), np.concatenate(places)
    order = np.argsort(source, kind="stable")
    return source[order], place[order]


def add_dots(axes: Axes, size: Array, *, cover: float = COVER, edge: float = 0.0) -> EllipseCollection:
    """Add dots to axes, to be placed by `set_offsets`.

    Args:
        size: distance between dots (M,), in the axes' unit.
        cover: diameter in those distances.
        edge: width of the white line around a dot [points]; it tells near dots from far ones.
    """
    from matplotlib.collections import EllipseCollection

    dots = EllipseCollection(
        cover * size, cover * size, np.zeros(len(size)), units="xy", offsets=np.zeros((len(size), 2)),
        offset_transform=axes.transData, rasterized=True, edgecolors="white", linewidths=edge,
    )  # fmt: skip
    axes.add_collection(dots)
    return dots


def far_to_near(x: Array, look: View) -> Array:
    """Return the order in which dots at x (M, D) are drawn, so that near ones cover far ones."""
    return np.argsort(x @ look.towards, kind="stable")
