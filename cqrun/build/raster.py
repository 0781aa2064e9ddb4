"""Measure how thick a body is, on a fine raster of its shape: shapes, meshes and images alike."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from cqrun.geometry.place import Place
from cqrun.geometry.shape import cell_centres, finite_bounds
from cqrun.plugin.contract import Array
from cqrun.scene.body import Body

PER_CELL = 4
"""Points per grid cell and axis that measure bodies and gaps; fewer in a body that needs more than MOST_POINTS."""

MOST_POINTS = 500_000

ROUNDED = 0.4
"""Distance of a corner from the largest disc or ball inside that is not thin [diameters]: a cube's is 0.37."""

THIN = 0.1
"""Share of a body that must be thin to count as its thin part."""


LARGE = 0.1
"""Share of the centres of balls that a part must have, to be joined to the others by a neck."""


@dataclass(frozen=True)
class Raster:
    """Which cells of a fine raster lie in a body.

    Attributes:
        solid: (...) bool.
        corner: lower corner in the body's coordinates, after the scale of `place` [m].
        pitch: edge of a cell [m].
    """

    solid: Array
    corner: Array
    pitch: float

    @cached_property
    def thickness(self) -> float:
        """The thickness of the thinnest part [m]: a tenth of the body, or a neck if that is thinner."""
        return thinnest(self.solid) * self.pitch


def rasterised(body: Body, dx: float) -> Raster:
    """Return the raster of a body for a grid spacing dx [m]."""
    scale, pieces = (body.place or Place()).scale, list(body.pieces.values())
    bounds = [finite_bounds(piece) for piece in pieces]
    lower, upper = np.min([low for low, _ in bounds], axis=0), np.max([high for _, high in bounds], axis=0)
    volume = float(np.prod(upper - lower)) * scale ** len(lower)
    pitch = max(dx / PER_CELL, (volume / MOST_POINTS) ** (1 / len(lower)))
    shortest = float(np.min(upper - lower)) * scale
    pitch = shortest / max(1, round(shortest / pitch))  # so that a bar has its exact thickness
    counts = np.ceil((upper - lower) * scale / pitch * (1 - 1e-9)).astype(int)
    x = cell_centres(lower, np.full(len(lower), pitch / scale), counts)
    return Raster(np.any([piece.inside(x) for piece in pieces], axis=0).reshape(counts), lower * scale, pitch)


def thinner(solid: Array, width: float, depths: Array | None = None) -> Array:
    """Return which cells of a solid lie where no ball of a given diameter fits; corners of thicker parts do not count.

    Args:
        solid: (...) bool.
        width: the diameter, in cells.
        depths: `depth` of the solid, if it is known.
    """
    filled = (depth(solid) if depths is None else depths) >= 0.5 * width * (1 - 1e-6)  # a width in cells may be rounded
    if not filled.any():
        return solid
    reach = ndimage.distance_transform_edt(~filled)
    return np.asarray(solid & (reach > (0.5 + ROUNDED) * width))


def neck(solid: Array, width: float, depths: Array | None = None) -> Array:
    """Return the cells thinner than a width, if the solid falls into more parts without them; else none."""
    thin = thinner(solid, width, depths)
    _, parts = ndimage.label(solid & ~thin)
    return thin & (parts > ndimage.label(solid)[1])


def membrane(solid: Array, width: float, depths: Array | None = None) -> Array:
    """Return the cells thinner than a width that part a cavity from the outside or from another cavity; else none."""
    thin = thinner(solid, width, depths)
    parts, spaces = ndimage.label(np.pad(thin, 1))[0], ndimage.label(~np.pad(solid, 1))[0]
    if spaces.max() < 2:
        return np.zeros_like(thin)
    beside = []  # pairs of a thin part and a space that touch
    for axis in range(solid.ndim):
        for one, other in ((1, -1), (-1, 1)):
            part, space = (np.take(a, range(max(k, 0), a.shape[axis] + min(k, 0)), axis)
                           for a, k in ((parts, one), (spaces, other)))  # fmt: skip
            touch = (part > 0) & (space > 0)
            beside.append(np.stack([part[touch], space[touch]], axis=1))
    pairs = np.unique(np.concatenate(beside), axis=0)
    return np.isin(parts, np.flatnonzero(np.bincount(pairs[:, 0]) > 1))[(slice(1, -1),) * solid.ndim]


def depth(solid: Array) -> Array:
    """Return the distance of each cell to the nearest one outside a solid [cells]; at most (n + 1) // 2 in n layers."""
    inner = (slice(1, -1),) * solid.ndim
    return np.asarray(ndimage.distance_transform_edt(np.pad(solid, 1)))[inner]


def thinnest(solid: Array) -> float:
    """Return the thickness of the thinnest part of a solid [cells]: of a tenth of it, or of a neck if that is thinner.

    A width is too large for a tenth of the solid if no ball of that diameter fits there.
    """
    depths = depth(solid)
    low, high = 1, int(np.ceil(2.0 * depths.max())) + 1  # no cell is thinner than `low`, and all are than `high`
    middle = high - 1  # the only width to try if the solid is equally thick everywhere
    while high - low > 1:
        too_large = thinner(solid, middle, depths).sum() > THIN * solid.sum()
        low, high = (low, middle) if too_large else (middle, high)
        middle = (low + high) // 2
    return min(across(solid, depths, thinner(solid, high, depths))[0], _narrowest(solid, depths))


def _narrowest(solid: Array, depths: Array) -> float:
    """Return the thickness of the narrowest neck between large parts of a solid [cells]; inf without any.

    Centres of balls of a diameter that does not fit through a neck lie in several separate places.
    """
    whole, width, last = ndimage.label(solid)[1], 2, 1
    while width <= 2.0 * depths.max():
        places, count = ndimage.label(depths >= 0.5 * width)
        if count > whole:
            sizes = np.bincount(places.reshape(-1))[1:]
            if (sizes >= LARGE * sizes.sum()).sum() > whole:
                return float(last)
        last, width = width, width + max(1, width // 8)
    return np.inf


def across(solid: Array, depths: Array, part: Array) -> tuple[float, Array]:
    """Return the thickness of a part of a solid [cells], and a cell (D,) where it is that thick.

    It is the median in the middle of walls, because where walls meet they are deeper. Twice the depth is one cell too
    many for an odd number of layers, so the run of cells along each axis counts, too.
    """
    cells = np.argwhere(part & (depths == ndimage.maximum_filter(depths, 3)))
    if not len(cells):  # the part has its middle in a thicker one
        cells = np.argwhere(part & (depths == np.max(depths, where=part, initial=0.0)))
    at = tuple(cells.T)
    thickness = np.minimum.reduce([2.0 * depths[at], *(_runs(solid, axis)[at] for axis in range(solid.ndim))])
    middle = np.sort(thickness)[(len(cells) - 1) // 2]
    return float(middle), cells[int(np.argmax(thickness == middle))]


def _runs(solid: Array, axis: int) -> Array:
    """Return how many cells of a solid lie in a row along an axis, for each of its cells."""
    line = np.moveaxis(solid, axis, -1)
    number = np.arange(line.shape[-1])
    before = np.maximum.accumulate(np.where(line, -1, number), axis=-1)
    after = np.minimum.accumulate(np.where(line, line.shape[-1], number)[..., ::-1], axis=-1)[..., ::-1]
    return np.moveaxis(after - before - 1, -1, axis)
