"""The numbers with which kernels find the distance from a closed triangle mesh (boundaries/mesh_solid.py)."""

from __future__ import annotations

import numpy as np

from cqrun.boundaries.mesh_solid import BOX, HEAD, TRIANGLE
from cqrun.boundaries.solid import Solid
from cqrun.geometry.edges import Edges
from cqrun.plugin.contract import Array

TOLERANCE = 1e-12
"""Distance within which two places are one, relative to the diagonal of the mesh: some thousand roundings."""

IN_LEAF = 4
"""Most triangles of a leaf."""

TURNS = 20
"""Most edges that are turned for each triangle without a height."""


def mesh_numbers(vertices: Array, faces: Array) -> Array:
    """Return the numbers of a closed mesh, with a scale of 1: those of `Solid.lengths` of the kind MESH.

    Args:
        vertices: (V, 3) in any unit, each place once.
        faces: (T, 3) indices of vertices, counterclockwise seen from outside.
    """
    tolerance = TOLERANCE * float(np.linalg.norm(np.ptp(vertices[faces].reshape(-1, 3), axis=0)))
    faces = _longest_first(vertices, _with_heights(vertices, faces, tolerance))
    depth = max(0, int(np.ceil(np.log2(len(faces) / IN_LEAF))))
    faces = faces[_order(vertices[faces].mean(axis=1), depth)]
    frame = _frames(vertices, faces, tolerance)
    corners = vertices[faces]
    head = [1.0, tolerance, len(faces), depth]
    normals = _normals(vertices, faces, frame[:, 9:12] * (frame[:, 14:] > 0.0))
    return np.concatenate([head, _boxes(corners, depth).ravel(), frame.ravel(), normals.ravel()])


def mesh_triangles(solid: Solid) -> Array:
    """Return the corners (T, 3, 3) [m] of the triangles of a solid of the kind MESH, counterclockwise from outside."""
    numbers = solid.lengths
    count, begin = int(numbers[2]), HEAD + BOX * ((2 << int(numbers[3])) - 1)
    frame = numbers[begin : begin + TRIANGLE * count].reshape(count, TRIANGLE)
    a, e, f = frame[:, :3], frame[:, 3:6], frame[:, 6:9]
    local = np.stack([a, a + frame[:, 12:13] * e, a + frame[:, 13:14] * e + frame[:, 14:] * f], axis=1)
    return np.asarray(solid.points[0] + numbers[0] * local @ solid.directions)


def _with_heights(vertices: Array, faces: Array, tolerance: float) -> Array:
    """Return faces that cover the same surface without those that have no height.

    Programs leave such faces where an edge meets the middle of another one, and no side can be told by them: their
    longest edge is turned to the other diagonal of the two faces that meet there. A face that cannot be turned stays.
    """
    every = faces.copy()
    for _ in range(TURNS):
        every = _longest_first(vertices, every)
        thin = np.flatnonzero(_frames(vertices, every, tolerance)[:, 14] <= 0.0)
        if not len(thin):
            break
        sides = zip(every.ravel().tolist(), np.roll(every, -1, axis=1).ravel().tolist(), strict=True)
        owner = {side: k // 3 for k, side in enumerate(sides)}
        gone, turned = set[int](), set[int]()
        for k in thin.tolist():
            p, q, r = (int(v) for v in every[k])
            other = owner.get((q, p))
            if other is None or {k, other} & (gone | turned):
                continue
            s = next(int(v) for v in every[other] if v not in (p, q))
            if s == r:  # back to back
                gone |= {k, other}
            else:
                every[k], every[other] = (r, p, s), (s, q, r)
                turned |= {k, other}
        if not gone | turned:
            break
        every = np.delete(every, sorted(gone), axis=0)
    return every


def _longest_first(vertices: Array, faces: Array) -> Array:
    """Return the faces, turned so that their first edge is the longest."""
    corners = vertices[faces]
    first = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).argmax(axis=1)
    return np.asarray(np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1))


def _frames(vertices: Array, faces: Array, tolerance: float) -> Array:
    """Return the 15 numbers (T, 15) of faces whose first edge is the longest; a height within the tolerance is zero.

    The height is made orthogonal to the edge twice, since much of it cancels in a thin face.
    """
    a, b, c = vertices[faces].transpose(1, 0, 2)
    length = np.linalg.norm(b - a, axis=1, keepdims=True)
    e = (b - a) / length
    along = np.einsum("nd,nd->n", c - a, e)[:, None]
    across = c - a - along * e
    across -= np.einsum("nd,nd->n", across, e)[:, None] * e
    height = np.linalg.norm(across, axis=1, keepdims=True)
    flat = height <= tolerance
    any_across = np.cross(e, np.eye(3)[np.abs(e).argmin(axis=1)])
    f = np.where(flat, any_across, across)
    f = f / np.linalg.norm(f, axis=1, keepdims=True)
    return np.concatenate([a, e, f, np.cross(e, f), length, along, np.where(flat, 0.0, height)], axis=1)


def _normals(vertices: Array, faces: Array, normal: Array) -> Array:
    """Return sums of normals (T, 6, 3): of faces at the edges ab, bc, ca, and around corners, times their angles."""
    edges = Edges.of(faces)
    at_edge, at_corner = np.zeros((len(edges.ends), 3)), np.zeros((len(vertices), 3))
    corners = vertices[faces]
    for k in range(3):
        np.add.at(at_edge, edges.at[:, k], normal)
        one, other = corners[:, k - 2] - corners[:, k], corners[:, k - 1] - corners[:, k]
        angle = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), np.einsum("nd,nd->n", one, other))
        np.add.at(at_corner, faces[:, k], angle[:, None] * normal)
    return np.concatenate([at_edge[edges.at], at_corner[faces]], axis=1)


def _order(middle: Array, depth: int) -> Array:
    """Return the order (T,) of triangles in the leaves of a tree that halves them along the longest axis."""
    count, order = len(middle), np.arange(len(middle))
    for level in range(depth):
        begin = count * np.arange(2**level) // 2**level
        x, part = middle[order], np.repeat(np.arange(2**level), np.diff([*begin, count]))
        size = np.maximum.reduceat(x, begin) - np.minimum.reduceat(x, begin)
        key = x[np.arange(count), size.argmax(axis=1)[part]]
        order = order[np.lexsort((key, part))]
    return order


def _boxes(corners: Array, depth: int) -> Array:
    """Return the boxes (2^(depth + 1) - 1, 6) of a tree around triangles (T, 3, 3) in order, the root first."""
    begin = len(corners) * np.arange(2**depth) // 2**depth
    level = np.concatenate([np.minimum.reduceat(corners.min(axis=1), begin),
                            np.maximum.reduceat(corners.max(axis=1), begin)], axis=1)  # fmt: skip
    levels = [level]
    for _ in range(depth):
        low, high = level.reshape(-1, 2, 6)[..., :3].min(axis=1), level.reshape(-1, 2, 6)[..., 3:].max(axis=1)
        level = np.concatenate([low, high], axis=1)
        levels.insert(0, level)
    return np.concatenate(levels)
