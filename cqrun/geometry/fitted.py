"""Fit the particles of a lattice to a shape: each gets the volume and the centre of the part of the shape around it.

The part of a particle is what the shape has of its cell, and of cells next to it that have no particle. Cells that the
surface cuts are measured with points, those of a rank-1 lattice and its mirror images (I. H. Sloan, S. Joe: Lattice
Methods for Multiple Integration (1994)). Along every axis these have many different coordinates, so that a flat face is
found to a small part of a cell, and they are symmetric, so that a symmetric shape stays so.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy import ndimage

from cqrun.geometry.shape import Shape, cell_centres
from cqrun.plugin.contract import Array

GENERATORS = {2: (34, (1, 25)), 3: (16, (1, 5, 9))}
"""Number of points of the rank-1 lattice and its generating vector, by dimension: the best for half-spaces."""

CORNERS = 0.5 - 1e-6
"""Where the corners of a cell are looked at [cells]; on the corner itself, a face of the shape would be ambiguous."""

EQUAL = 1e-9
"""Relative difference of squared distances that are the same; such points belong to several particles."""

SURE = 1.5
"""Distance within which the nearest particle is in a cell next to the point's own one [cells]."""

CHUNK = 2_000_000
"""Number of points that are looked at together, or of distances."""


def fit(shape: Shape, corner: Array, size: Array, counts: Array) -> tuple[Array, Array]:
    """Return the centres (N, D) [m] and the volumes (N,) [m^D] of the parts of a shape, one for each particle.

    The cells of the lattice with their centre in the shape have a particle. What is more than a cell away from all
    particles belongs to none. A centre outside the shape, in a sharply bent wall, stays at that of its cell.

    Args:
        shape: lies within the lattice.
        corner: lower corner of the lattice (D,) [m].
        size: of a cell (D,) [m].
        counts: cells along each axis (D,).
    """
    centres = cell_centres(corner, size, counts)
    full = shape.inside(centres).reshape(tuple(counts))
    number = np.cumsum(full).reshape(full.shape) - 1
    n, dim = int(full.sum()), len(size)
    share, moment = np.zeros(n), np.zeros((n, dim))  # in cells, and about the particle's own cell
    around = np.ones((3,) * dim)
    inner = ndimage.binary_erosion(full, around)
    rim = np.argwhere(ndimage.binary_dilation(full, around) & ~inner)
    cut, whole = _cut(shape, corner, size, rim, full[tuple(rim.T)])
    share[number[inner]] = 1.0
    share[number[tuple(rim[whole].T)]] = 1.0
    points = _points(dim)
    for cells in _chunks(rim[cut], len(points)):
        place, offset = np.divmod(np.flatnonzero(_inside(shape, corner, size, cells, points)), len(points))
        for particle, to, part in _owners(full, number, cells[place], points[offset], size):
            share += np.bincount(particle, part, n) / len(points)
            moment += np.stack([np.bincount(particle, part * axis, n) for axis in to.T], axis=1) / len(points)
    share = np.where(share > 0, share, 1.0 / len(points))  # a sliver between the points
    own = centres[full.reshape(-1)]
    x = own + moment / share[:, None] * size
    moved = np.flatnonzero(moment.any(axis=1))
    out = moved[~shape.inside(x[moved])]
    x[out] = own[out]
    return x, share * float(np.prod(size))


def _points(dim: int) -> Array:
    """Return the points (P, D) of a unit cell, from its middle."""
    n, generator = GENERATORS[dim]
    first = ((np.arange(n)[:, None] * np.array(generator)) % n + 0.5) / n - 0.5
    return np.concatenate([first * np.array(sign) for sign in product((1, -1), repeat=dim)])


def _chunks(items: Array, each: int) -> list[Array]:
    """Return items in parts, of which each item takes some points."""
    return np.array_split(items, max(1, each * len(items) // CHUNK))


def _inside(shape: Shape, corner: Array, size: Array, cells: Array, points: Array) -> Array:
    """Return which points (P, D) of cells (C, D) are in the shape: (C * P,) bool."""
    x = corner + (cells[:, None] + 0.5 + points) * size
    return shape.inside(x.reshape(-1, len(size)))


def _cut(shape: Shape, corner: Array, size: Array, cells: Array, centre: Array) -> tuple[Array, Array]:
    """Return which cells (C, D) the surface cuts, and which are whole, by corners, middles of edges and faces."""
    probes = CORNERS * np.array([step for step in product((-1, 0, 1), repeat=len(size)) if any(step)])
    found = np.concatenate([_inside(shape, corner, size, part, probes) for part in _chunks(cells, len(probes))])
    found = found.reshape(-1, len(probes))
    whole = found.all(axis=1) & centre
    return (found.any(axis=1) | centre) & ~whole, whole


def _owners(full: Array, number: Array, cells: Array, points: Array, size: Array) -> list[tuple[Array, Array, Array]]:
    """Return the particles that own points, where the points are from them, and their part of the points.

    Args:
        full: which cells have a particle (...).
        number: of the particle of each cell (...).
        cells: of the points (K, D).
        points: from the middles of their cells (K, D) [cells].
        size: of a cell (D,) [m].
    """
    own = full[tuple(cells.T)]
    owners = [(number[tuple(cells[own].T)], points[own], np.ones(int(own.sum())))]
    lost_cells, lost = cells[~own], points[~own]
    for reach in (1, 2):
        if not len(lost):
            break
        steps = np.array([step for step in product(range(-reach, reach + 1), repeat=len(size)) if any(step)])
        at, step, least = _nearest(full, lost_cells, lost, size, steps)
        if reach == 1:  # a cell two steps away may be nearer
            sure = least <= (SURE * size.min()) ** 2
            at, step = (each[sure[at]] for each in (at, step))
        to = lost_cells[at] + steps[step]
        ties = np.bincount(at, minlength=len(lost))[at]
        owners.append((number[tuple(to.T)], lost[at] - steps[step], 1.0 / ties))
        if reach == 1:
            lost_cells, lost = lost_cells[~sure], lost[~sure]
    return owners


def _nearest(full: Array, cells: Array, points: Array, size: Array, steps: Array) -> tuple[Array, Array, Array]:
    """Return pairs of points and steps to the nearest particles, and the least squared distances (K,) [m^2]."""
    padded = np.pad(full, 2)  # the longest step
    at, step, least = [], [], []
    for part in _chunks(np.arange(len(points)), len(steps)):
        square = np.zeros((len(part), len(steps)))
        for axis in range(len(size)):
            square += (size[axis] * (points[part, axis, None] - steps[:, axis])) ** 2
        to = cells[part, None] + steps + 2
        square[~padded[tuple(np.moveaxis(to, -1, 0))]] = np.inf
        nearest = square.min(axis=1)
        rows, columns = np.nonzero(square <= nearest[:, None] * (1 + EQUAL))
        at.append(part[rows])
        step.append(columns)
        least.append(nearest)
    return np.concatenate(at), np.concatenate(step), np.concatenate(least)
