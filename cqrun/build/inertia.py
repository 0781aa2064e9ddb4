"""Volume, centroid and moments of inertia of shapes: by formula, or else counted on a lattice."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cqrun.boundaries.solid import BOX, CAPSULE, CONE, MESH, Solid
from cqrun.geometry.mesh_tree import mesh_triangles
from cqrun.geometry.shape import Shape, cell_centres, finite_bounds
from cqrun.plugin.contract import Array

CELLS = 400_000
"""Approximate number of cells of the lattice."""

SAME = 1e-3
"""Relative difference up to which two counted moments are taken as equal: that of the lattice."""


class MassProperties(NamedTuple):
    """Of a shape of density 1: its volume [m^D], centroid (3,) [m] and inertia about it (3, 3) [m^(D+2)]."""

    volume: float
    center: Array
    inertia: Array


def mass_properties(shape: Shape, solids: list[Solid]) -> MassProperties:
    """Return the mass properties of a shape, which is the union of these solids.

    Raises:
        UsageError: it is infinite.
    """
    lower, upper = finite_bounds(shape)
    if len(solids) == 1 and (known := _by_formula(solids[0])) is not None:
        return known
    return _counted(shape, lower, upper)


def _by_formula(solid: Solid) -> MassProperties | None:
    dim = solid.points.shape[1]
    if solid.kind == CAPSULE and (solid.points[0] == solid.points[1]).all():
        r = float(solid.lengths[0])
        volume = np.pi * r**2 if dim == 2 else 4.0 / 3.0 * np.pi * r**3
        return MassProperties(volume, _full(solid.points[0]), volume * r**2 * (0.5 if dim == 2 else 0.4) * np.eye(3))
    if solid.kind == BOX:
        half, volume = solid.lengths[:dim], float(np.prod(2.0 * solid.lengths[:dim]))
        squares = volume / 3.0 * half**2
        axes = np.pad(solid.directions[:dim], ((0, 0), (0, 3 - dim)))
        return MassProperties(volume, _full(solid.points[0]), _inertia(axes.T @ np.diag(squares) @ axes, dim))
    if solid.kind == CONE and solid.lengths[0] == solid.lengths[1] and dim == 3:
        axis, r = solid.points[1] - solid.points[0], float(solid.lengths[0])
        h = float(np.linalg.norm(axis))
        along, volume = np.outer(axis, axis) / h**2, np.pi * r**2 * h
        squares = volume * (r**2 / 4.0 * (np.eye(3) - along) + h**2 / 12.0 * along)
        return MassProperties(volume, solid.points.mean(axis=0), _inertia(squares, dim))
    if solid.kind == MESH:
        return _enclosed(mesh_triangles(solid))
    return None


def _enclosed(corners: Array) -> MassProperties:
    """Return those of what triangles (T, 3, 3) enclose: sums over tetrahedra with a common corner (Gauss's theorem).

    A tetrahedron with corners 0, a, b, c has det(a, b, c) / 6 as volume, a quarter of s = a + b + c as centroid, and
    det / 120 (a a^T + b b^T + c c^T + s s^T) as integral of x x^T.
    """
    middle = corners.mean(axis=(0, 1))  # a common corner near the centroid, so that little cancels
    x = corners - middle
    det, s = np.linalg.det(x), x.sum(axis=1)
    volume = float(det.sum()) / 6.0
    center = det @ s / (24.0 * volume)
    squares = (np.einsum("t,tki,tkj->ij", det, x, x) + np.einsum("t,ti,tj->ij", det, s, s)) / 120.0
    return MassProperties(volume, middle + center, _inertia(squares - volume * np.outer(center, center), 3))


def _counted(shape: Shape, lower: Array, upper: Array) -> MassProperties:
    size, dim = upper - lower, len(lower)
    spacing = float(np.prod(size) / CELLS) ** (1 / dim)
    counts = 4 * np.ceil(size / (4 * spacing)).astype(int)
    x = cell_centres(lower, size / counts, counts)
    x = x[shape.inside(x)]
    volume = float(len(x) / np.prod(counts) * np.prod(size))
    center = x.mean(axis=0)
    arm = np.pad(x - center, ((0, 0), (0, 3 - dim)))
    return MassProperties(volume, _full(center), _inertia(volume * arm.T @ arm / len(x), dim))


def _inertia(squares: Array, dim: int) -> Array:
    """Return the inertia (3, 3) for the second moments (3, 3); in 2D that about z, in all directions."""
    total = np.trace(squares)
    return total * np.eye(3) if dim == 2 else total * np.eye(3) - squares


def _full(x: Array) -> Array:
    return np.pad(np.asarray(x, float), (0, 3 - len(x)))


def principal(inertia: Array) -> tuple[Array, Array]:
    """Return the moments (3,), increasing, and the axes as rows (3, 3); moments that are nearly equal become equal."""
    moments, axes = np.linalg.eigh(inertia)
    for k in (0, 1):
        if moments[k + 1] - moments[k] <= SAME * moments[2]:
            moments[k] = moments[k + 1] = 0.5 * (moments[k] + moments[k + 1])
    if moments[2] - moments[0] <= SAME * moments[2]:
        moments[:] = moments.mean()
    return moments, axes.T
