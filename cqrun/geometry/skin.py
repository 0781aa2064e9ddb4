"""The surface of a shape as points and facets, from nothing but the test whether a point is inside.

Dual contouring (T. Ju et al., ACM Trans. Graph. 21 (2002)): the corners of a lattice are inside or outside, and a cell
whose corners differ has one point of the surface. The surface crosses the cell's edges at places with normals; the
point is where the planes through these places meet, in the sense of least squares. So edges and corners of a body are
kept. At last each point moves along the mean normal onto the surface itself.

The lattice divides the shape's bounds into equal cells, and the bounds' faces lie halfway between its corners. So a box
gets the points of a regular lattice on its faces, edges and corners.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cqrun.plugin.contract import Array

Inside = Callable[[Array], Array]
"""Returns which points (n, D) are inside: (n,) bool."""

Distance = Callable[[Array], tuple[Array, Array]]
"""Returns the signed distances of points (n, D) from a surface (n,), negative inside, and its normals next to them."""

MOST_STEPS = 40
"""Of the search for a zero of a distance along a line. At a flat piece of a surface one is enough."""

ON = 1e-10
"""Distance from a surface at which a point is on it [cells]."""

HALVINGS = 44
"""Of an interval of a cell: to the last bits of a coordinate."""

HALVINGS_OF_ANGLE = 26
"""Of a half turn: to 5e-8."""

NEAR = 1e-3
"""Radius of the circles on which normals are found [cells]."""

SHARP = 0.1
"""Least ratio of eigenvalues from which planes meet: those of two planes at 35 degrees."""


REACHES = (1e-6, 1e-3, 1 / 16, 1 / 4, 1 / 2)
"""How far a point is from the surface, at most, in steps [cells]."""


class Skin(NamedTuple):
    """A surface.

    Attributes:
        x: points (S, D) [m].
        area: area of each (S,) [m^(D-1)]; they sum to that of the facets.
        facets: (T, D) points of each segment or triangle. In 2D the normal is the edge turned clockwise, in 3D it is
            that of the right hand; normals point outward.
    """

    x: Array
    area: Array
    facets: Array


class _Crossings(NamedTuple):
    """Where the surface crosses the edges of the lattice.

    `corner` (E, D) is the lower corner of the edge, `axis` (E,) its axis; `leaves` says whether the upper corner is
    outside. `x` (E, D) are the places, and `normal` (E, D) the normals there.
    """

    corner: Array
    axis: Array
    leaves: Array
    x: Array
    normal: Array


def make_skin(inside: Inside, lower: Array, upper: Array, spacing: float, distance: Distance | None = None) -> Skin:
    """Return the surface of a shape with these bounds (D,), with points at distances of at most about `spacing`.

    With a `distance` far fewer points are tested, which matters for a mesh.
    """
    counts = np.maximum(np.ceil((upper - lower) / spacing * (1 - 1e-9)), 1).astype(int)
    pitch = (upper - lower) / counts
    axes = [low + (np.arange(n + 2) - 0.5) * h for low, n, h in zip(lower, counts, pitch, strict=True)]
    corners = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    solid = inside(corners.reshape(-1, len(lower))).reshape(corners.shape[:-1])
    line = _Line(inside, distance, float(pitch.min()))
    crossings = _crossings(line, corners, solid)
    cells = counts + 1
    number, x, normal = _points(crossings, corners, pitch, tuple(cells))
    x = _onto(line, x, normal)
    return _joined(crossings, number, x, tuple(cells))


class _Line(NamedTuple):
    """Finds where lines cross a surface.

    `inside` and `distance` are those of `make_skin`, `pitch` is the edge of a cell [m].
    """

    inside: Inside
    distance: Distance | None
    pitch: float

    def crossing(self, inner: Array, outer: Array) -> Array:
        """Return the points (n, D) of the surface between points inside and outside."""
        if self.distance is None:
            t = _halved(lambda t: self.inside(inner + t[:, None] * (outer - inner)), len(inner), HALVINGS)
            return inner + t[:, None] * (outer - inner)
        return _zero(self.distance, inner, outer, ON * self.pitch)

    def normals(self, x: Array, out: Array) -> Array:
        """Return outward normals at points x (n, D) of the surface; `out` (n, D) points out of it, along an axis."""
        if self.distance is None:
            return _normals(self.inside, x, out, NEAR * self.pitch)
        return self.distance(x)[1]


def _zero(distance: Distance, inner: Array, outer: Array, near: float) -> Array:
    """Return points (n, D) between `inner` and `outer` at a distance of less than `near` from the surface.

    The method of Illinois (Dowell and Jarratt, BIT 11 (1971)): a secant, whose old end counts half if it stays.
    """
    low, high = np.zeros(len(inner)), np.ones(len(inner))
    if not len(inner):
        return inner
    d_low, d_high = (np.asarray(distance(end)[0], float) for end in (inner, outer))
    at, side, waiting = 0.5 * (low + high), np.zeros(len(inner)), np.arange(len(inner))
    for _ in range(MOST_STEPS):
        w = waiting
        gap = d_high[w] - d_low[w]
        secant = (low[w] * d_high[w] - high[w] * d_low[w]) / np.where(gap > 0, gap, 1.0)
        at[w] = np.clip(np.where(gap > 0, secant, 0.5 * (low[w] + high[w])), low[w], high[w])
        d = distance(inner[w] + at[w, None] * (outer[w] - inner[w]))[0]
        within = d < 0
        again = side[w] == np.where(within, -1, 1)
        d_high[w] = np.where(within, np.where(again, 0.5 * d_high[w], d_high[w]), d)
        d_low[w] = np.where(within, d, np.where(again, 0.5 * d_low[w], d_low[w]))
        low[w], high[w] = np.where(within, at[w], low[w]), np.where(within, high[w], at[w])
        side[w] = np.where(within, -1, 1)
        waiting = w[np.abs(d) > near]
        if not len(waiting):
            break
    return np.asarray(inner + at[:, None] * (outer - inner))


def _crossings(line: _Line, corners: Array, solid: Array) -> _Crossings:
    """Return the crossings of a lattice's edges; `corners` (..., D), `solid` (...)."""
    dim, found = solid.ndim, []
    for axis in range(dim):
        low, high = (np.take(solid, np.arange(a, solid.shape[axis] - 1 + a), axis) for a in (0, 1))
        corner = np.argwhere(low != high)
        found.append((corner, np.full(len(corner), axis), low[tuple(corner.T)]))
    corner, axes, leaves = (np.concatenate(each) for each in zip(*found, strict=True))
    step = np.eye(dim, dtype=int)[axes]
    ends = corners[tuple(corner.T)], corners[tuple((corner + step).T)]
    inner, outer = np.where(leaves[:, None], *ends), np.where(leaves[:, None], *ends[::-1])
    x = line.crossing(inner, outer)
    return _Crossings(corner, axes, leaves, x, line.normals(x, np.where(leaves[:, None], step, -step)))


def _halved(within: Callable[[Array], Array], n: int, halvings: int) -> Array:
    """Return n numbers between 0, where all are inside, and 1, where all are outside: where `within` changes."""
    low, high = np.zeros(n), np.ones(n)
    for _ in range(halvings if n else 0):
        middle = 0.5 * (low + high)
        yes = within(middle)
        low, high = np.where(yes, middle, low), np.where(yes, high, middle)
    return 0.5 * (low + high)


def _normals(inside: Inside, x: Array, out: Array, radius: float) -> Array:
    """Return outward normals at points x (E, D) of the surface; `out` (E, D) is a direction out of it, along an axis.

    On a circle around a point, the surface leaves the direction `out` by an angle to each side; between them lies a
    chord, and chords of D - 1 circles span the tangent plane.
    """
    n, dim = x.shape
    # 2 (D - 1) half circles around each point, from inside to outside by a direction across
    turned = [np.roll(np.abs(out), k, axis=1) for k in range(1, dim)]
    across = np.concatenate([side * each for each in turned for side in (1, -1)])
    centre, outer = np.tile(x, (2 * (dim - 1), 1)), np.tile(out, (2 * (dim - 1), 1))

    def on_circle(t: Array) -> Array:
        angle = np.pi * t[:, None]
        return np.asarray(centre + radius * (np.sin(angle) * across - np.cos(angle) * outer))

    ends = on_circle(_halved(lambda t: inside(on_circle(t)), len(centre), HALVINGS_OF_ANGLE)).reshape(-1, 2, n, dim)
    chords = ends[:, 0] - ends[:, 1]
    normal = np.stack([chords[0][:, 1], -chords[0][:, 0]], axis=1) if dim == 2 else np.cross(*chords)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal *= np.sign(np.einsum("nd,nd->n", normal, out))[:, None] / np.where(length > 0, length, 1.0)
    simple = ~inside(x + radius * out) & inside(x - radius * out) & (length[:, 0] > 0)
    return np.where(simple[:, None], normal, out)


def _points(crossings: _Crossings, corners: Array, pitch: Array, cells: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Return the number of each cell's point (-1 if none), the points (S, D) and their mean normals (S, D)."""
    dim = len(cells)
    edge, cell = [], []
    for shift in np.ndindex(*(2,) * dim):
        some = np.flatnonzero(np.array(shift)[crossings.axis] == 0)  # cells around an edge
        around = crossings.corner[some] - np.array(shift)
        real = ((around >= 0) & (around < cells)).all(axis=1)
        edge.append(some[real])
        cell.append(np.ravel_multi_index(tuple(around[real].T), cells))
    edges = np.concatenate(edge)
    used, at = np.unique(np.concatenate(cell), return_inverse=True)
    number = np.full(int(np.prod(cells)), -1)
    number[used] = np.arange(len(used))
    q, m = crossings.x[edges], crossings.normal[edges]

    def summed(value: Array) -> Array:
        out = np.zeros((len(used), *value.shape[1:]))
        np.add.at(out, at, value)
        return out

    mean = summed(q) / np.bincount(at)[:, None]
    planes = summed(m[:, :, None] * m[:, None, :])
    offset = summed(m * np.einsum("nd,nd->n", m, q - mean[at])[:, None])
    size, axes = np.linalg.eigh(planes)
    kept = size > SHARP * size[:, -1:]
    along = np.einsum("ndk,nd->nk", axes, offset) * kept / np.where(kept, size, 1.0)
    x = mean + np.einsum("ndk,nk->nd", axes, along)
    low = corners[(0,) * dim] + np.stack(np.unravel_index(used, cells), axis=1) * pitch
    x = np.clip(x, low, low + pitch)
    normal = summed(m)
    return number, x, normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def _onto(line: _Line, x: Array, normal: Array) -> Array:
    """Return points x (S, D) moved along their normals onto the surface; those far from it stay."""
    reach, inside = np.zeros(len(x)), line.inside
    if line.distance is not None:
        measure = line.distance
        inside = lambda points: measure(points)[0] < 0  # noqa: E731
    for each in line.pitch * np.array(REACHES):
        waiting = np.flatnonzero(reach == 0.0)
        along = each * normal[waiting]
        reach[waiting[inside(x[waiting] - along) & ~inside(x[waiting] + along)]] = each
    some = np.flatnonzero(reach)
    way, moved = reach[some, None] * normal[some], x.copy()
    moved[some] = line.crossing(x[some] - way, x[some] + way)
    return moved


def _joined(crossings: _Crossings, number: Array, x: Array, cells: tuple[int, ...]) -> Skin:
    """Return the surface: each crossing joins the points of the cells around its edge."""
    dim, quads = len(cells), []
    ring = [(0,), (1,)] if dim == 2 else [(1, 1), (0, 1), (0, 0), (1, 0)]  # steps down along the axes after the edge's
    for axis in range(dim):
        some = np.flatnonzero(crossings.axis == axis)
        others = [(axis + k) % dim for k in range(1, dim)]
        around = []
        for steps in ring:
            cell = crossings.corner[some].copy()
            cell[:, others] -= steps
            around.append(number[np.ravel_multi_index(tuple(cell.T), cells)])
        quad = np.stack(around, axis=1)
        # in 2D a step along y after x turns the other way than one along x after y
        forward = crossings.leaves[some] != (dim == 2 and axis == 0)
        quads.append(np.where(forward[:, None], quad, quad[:, ::-1]))
    quad = np.concatenate(quads)
    if dim == 2:
        size, facets = np.linalg.norm(x[quad[:, 1]] - x[quad[:, 0]], axis=1), quad
    else:
        a, b, c, d = (x[quad[:, k]] for k in range(4))
        by_ac = np.linalg.norm(a - c, axis=1) <= np.linalg.norm(b - d, axis=1)
        first = np.where(by_ac[:, None], quad[:, [0, 1, 2]], quad[:, [0, 1, 3]])
        second = np.where(by_ac[:, None], quad[:, [0, 2, 3]], quad[:, [1, 2, 3]])
        facets = np.concatenate([first, second])
        corners = x[facets]
        double = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        size = 0.5 * (double[: len(quad)] + double[len(quad) :])
    area = np.bincount(quad.ravel(), np.repeat(size / quad.shape[1], quad.shape[1]), len(x))
    return Skin(x, area, facets)
