"""Walls of cavities: closed sets of facets (segments in 2D, triangles in 3D) whose normals point out of the cavity.

With the points a, b (c) of a facet, its normal N has the length of the facet (3D: twice its area):

    2D: N = (b - a) turned clockwise, V = sum a x b / 2;    3D: N = (b - a) x (c - a), V = sum a . (b x c) / 6.

The wall is closed, so each point of a facet has the part N / 2 (3D: N / 6) of dV/dx, whatever the origin.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from cqrun.forces.force import Shares, Skin
from cqrun.numerics.compile import kernel
from cqrun.plugin.contract import Array
from cqrun.state import X

# --- in a scene -------------------------------------------------------------------------------------------------------


def cavities(skin: Skin) -> list[Array]:
    """Return the facets (T, D) of the wall around each cavity of a body."""
    n, facets = len(skin.x), skin.facets
    pairs = np.concatenate([facets[:, [0, k]] for k in range(1, facets.shape[1])])
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1][facets[:, 0]]
    parts = [facets[label == k] for k in np.unique(label)]
    return [part[:, ::-1] for part in parts if enclosed(skin.x, part) < 0.0]


def wall_constants(facets: Array, base: float = 0.0, scale: float = 1.0) -> Array:
    """Return the constants of a part with a wall: D, two numbers of its law, and the points of each facet (T, D)."""
    return np.concatenate([[float(facets.shape[1]), base, scale], facets.ravel().astype(float)])


def facets_in(constants: Array) -> Array:
    """Return the points of each facet (T, D) from a part's constants."""
    return constants[3:].astype(np.int64).reshape(-1, int(constants[0]))


def each_facet(columns: Array, constants: Array) -> list[Array]:
    """Return the points of each facet of a part: one item each."""
    return list(columns[facets_in(constants)])


def across(x: Array, facets: Array) -> Array:
    """Return a vector (T, D) along the normal of each facet, as long as its first edge, for points x (S, D)."""
    b = x[facets[:, 1]] - x[facets[:, 0]]
    if x.shape[1] == 2:
        return np.stack([b[:, 1], -b[:, 0]], axis=1)
    normal = np.cross(b, x[facets[:, 2]] - x[facets[:, 0]])
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.asarray(normal / np.where(size > 0, size, 1.0) * np.linalg.norm(b, axis=1, keepdims=True))


def enclosed(x: Array, facets: Array) -> Any:
    """Return the volume (2D: area) that facets with outward normals enclose, for points x (..., S, D)."""
    corners = x[..., facets, :] - x[..., facets[:1, :1], :]
    return np.linalg.det(corners).sum(axis=-1) / (2.0 if x.shape[-1] == 2 else 6.0)


def enclosed_vjp(x: Array, facets: Array, bar: Array) -> Array:
    """Return the cotangent of x (..., S, D) from that of the volume (...)."""
    dim, out = x.shape[-1], np.zeros(x.shape)
    a, b = x[..., facets[:, 0], :], x[..., facets[:, 1], :] - x[..., facets[:, 0], :]
    if dim == 2:
        part = 0.5 * np.stack([b[..., 1], -b[..., 0]], axis=-1)
    else:
        part = np.cross(b, x[..., facets[:, 2], :] - a) / 6.0
    part = part * bar[..., None, None]
    for k in range(dim):
        np.add.at(np.moveaxis(out, -2, 0), facets[:, k], np.moveaxis(part, -2, 0))
    return out


def winding(x: Array, facets: Array, point: Array) -> float:
    """Return how often closed facets wind around a point: 1 or -1 inside (Van Oosterom and Strackee 1983 in 3D)."""
    r = x[facets] - point
    size = np.linalg.norm(r, axis=2)
    if x.shape[1] == 2:
        across, along = np.linalg.det(r), np.einsum("td,td->t", r[:, 0], r[:, 1])
        return float(np.arctan2(across, along).sum() / (2.0 * np.pi))
    below = size.prod(axis=1)
    for k in range(3):
        below += np.einsum("td,td->t", r[:, k], r[:, (k + 1) % 3]) * size[:, (k + 2) % 3]
    return float(np.arctan2(np.linalg.det(r), below).sum() / (2.0 * np.pi))


# --- in kernels: shares s, s + 1 (, s + 2) are the points of a facet --------------------------------------------------

Vector = tuple[float, float, float]


@kernel
def entry(table: Array, p: int, row: int) -> float:
    """Return a number of a packed table."""
    w = table.shape[2]
    return float(table[p // w, row, p % w])


@kernel
def between(q: Array, p: int, r: int, in_3d: bool) -> Vector:
    """Return the vector from point p to point r."""
    x, y = entry(q, r, X) - entry(q, p, X), entry(q, r, X + 1) - entry(q, p, X + 1)
    return x, y, entry(q, r, X + 2) - entry(q, p, X + 2) if in_3d else 0.0


@kernel
def outer(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def edges_of(shares: Shares, s: int, q: Array) -> tuple[Vector, Vector]:
    """Return the edges of a facet from its first point, whose product is N; in 2D the second is that across the plane.

    In 2D, (b - a) x (0, 0, 1) is b - a turned clockwise.
    """
    in_3d = shares.force.shape[1] == 3
    first = between(q, shares.columns[s], shares.columns[s + 1], in_3d)
    return first, between(q, shares.columns[s], shares.columns[s + 2], in_3d) if in_3d else (0.0, 0.0, 1.0)


@kernel
def part_of(shares: Shares) -> float:
    """Return the part of N that each point of a facet has of dV/dx."""
    return 1.0 / 6.0 if shares.force.shape[1] == 3 else 0.5


@kernel
def volume_of(shares: Shares, item: int, q: Array) -> float:
    """Return the volume (2D: area) that the facets of an item enclose, seen from its first point."""
    begin, total, in_3d = shares.begin[item], 0.0, shares.force.shape[1] == 3
    for s in range(begin, shares.begin[item + 1], shares.force.shape[1]):
        b, c = edges_of(shares, s, q)
        a, n = between(q, shares.columns[begin], shares.columns[s], in_3d), outer(b, c)
        total += part_of(shares) * (a[0] * n[0] + a[1] * n[1] + a[2] * n[2])
    return total


@kernel
def press_facet(shares: Shares, s: int, pressure: float, q: Array) -> None:
    """Write the shares of a facet under a pressure [Pa]."""
    b, c = edges_of(shares, s, q)
    n, part = outer(b, c), part_of(shares) * pressure
    for k in range(shares.force.shape[1]):
        for d in range(shares.force.shape[1]):
            shares.force[s + k, d] = part * n[d]


@kernel
def facet_work(shares: Shares, s: int, q: Array, push_bar: Array) -> tuple[float, Vector]:
    """Return the cotangent of the pressure on a facet, part N . g, and the sum g of the points' cotangents."""
    x, y, z, dim = 0.0, 0.0, 0.0, shares.force.shape[1]
    for k in range(dim):
        x, y = x + entry(push_bar, shares.columns[s + k], 0), y + entry(push_bar, shares.columns[s + k], 1)
        z = z + entry(push_bar, shares.columns[s + k], 2) if dim == 3 else 0.0
    b, c = edges_of(shares, s, q)
    n = outer(b, c)
    return part_of(shares) * (n[0] * x + n[1] * y + n[2] * z), (x, y, z)


@kernel
def press_facet_vjp(shares: Shares, s: int, pressure: float, volume_bar: float, q: Array, g: Vector) -> None:
    """Write the cotangents of a facet's points: through its normal, with the sum g, and through the volume of the wall.

    With w = part (b x c) . g: w_b = part c x g, w_c = part g x b, w_a = -w_b - w_c. In 2D c is constant.
    """
    b, c = edges_of(shares, s, q)
    part, n, dim = part_of(shares), outer(b, c), shares.force.shape[1]
    by_b, by_c = outer(c, g), outer(g, b)
    for d in range(dim):
        way, first, last = volume_bar * part * n[d], pressure * part * by_b[d], pressure * part * by_c[d]
        shares.x_bar[s, d] = way - first
        shares.x_bar[s + 1, d] = way + first
        if dim == 3:
            shares.x_bar[s, d] -= last
            shares.x_bar[s + 2, d] = way + last


@kernel
def press_facet_jvp(shares: Shares, s: int, pressure: float, q: Array, move: Array) -> None:
    """Write to shares.x_bar how the shares of a facet under a pressure change with the displacements of its points."""
    b, c = edges_of(shares, s, q)
    dim, in_3d = shares.force.shape[1], shares.force.shape[1] == 3
    first = shift(move, shares.columns[s], shares.columns[s + 1], in_3d)
    last = shift(move, shares.columns[s], shares.columns[s + 2], True) if in_3d else (0.0, 0.0, 0.0)
    one, other = outer(first, c), outer(b, last)
    for k in range(dim):
        for d in range(dim):
            shares.x_bar[s + k, d] = part_of(shares) * pressure * (one[d] + other[d])


@kernel
def shift(move: Array, p: int, r: int, in_3d: bool) -> Vector:
    """Return the displacement of point r minus that of point p."""
    x, y = entry(move, r, 0) - entry(move, p, 0), entry(move, r, 1) - entry(move, p, 1)
    return x, y, entry(move, r, 2) - entry(move, p, 2) if in_3d else 0.0
