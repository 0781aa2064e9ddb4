"""Solids with a signed distance: the obstacles that bodies of the reference frame meet.

A solid is a kind and some numbers: points, directions and lengths in 3D. A world in 2D is the plane z = 0 of the 3D
one. `signed_distance` returns, for a position x:

    d        distance to the surface, negative inside [m]; outside it may be a lower bound
    n        unit normal, grad d, outward
    alpha    curvature [1/m] and t, a unit direction without curvature or zero, of grad n = alpha (I - n n^T - t t^T)

Only d is used outside, so only inside are n, alpha and t exact. Inside, the nearest point of a surface is unique but
for a set without volume; there a solid takes one side.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cqrun.boundaries.mesh_solid import of_mesh
from cqrun.numerics.compile import kernel, own_symbols
from cqrun.numerics.tensor import add, dot, scale, sub, vector
from cqrun.plugin.contract import Array

PLANE, BOX, CAPSULE, CONE, POLYGON, TERRAIN, HILLS, TAPER, MESH = range(9)
"""Kinds of solids."""

FAR = 1e300
ZERO = (0.0, 0.0, 0.0)


class Solid(NamedTuple):
    """A solid: points (p, D) [m], directions (q, D) [1] and lengths (r,) [m], which depend on its kind.

    PLANE     a point of the plane; its normal
    BOX       the centre; a unit vector along each axis; half the length of each edge
    CAPSULE   both ends of its axis, which may be the same; the radius
    CONE      both ends of its axis; the radius at each. A cylinder has the same twice.
    POLYGON   the origin of its plane; the plane's two unit vectors; two coordinates of each corner, in order.
              In 3D it is a prism without ends.
    TERRAIN   the same with a profile from left to right; the solid is below it. The ends continue horizontally.
    HILLS     the same with amplitude, wavelength, base and phase [rad] of a sinusoid
    TAPER     both ends of its axis; the radius of the ball at each. It is the smallest convex body around both balls.
    MESH      the origin of its coordinates; their three unit vectors; a scale, and numbers without a unit
              (mesh_solid.py). A place changes only the scale, so the tree of a mesh is made once.
    """

    kind: int
    points: Array
    directions: Array
    lengths: Array

    def placed(self, scale: float, rotation: Array, offset: Array) -> Solid:
        """Return it at offset + scale * rotation * x."""
        lengths = self.lengths * scale
        if self.kind == HILLS:
            lengths[3] = self.lengths[3]
        if self.kind == MESH:
            lengths[1:] = self.lengths[1:]
        return Solid(self.kind, offset + scale * self.points @ rotation.T, self.directions @ rotation.T, lengths)

    def numbers(self) -> Array:
        """Return the kernels' numbers: those of points and directions in 3D, then the lengths."""
        dim = self.points.shape[1]
        vectors = np.concatenate([self.points, self.directions.reshape(-1, dim)])
        lengths = self.lengths
        if self.kind == BOX and dim == 2:
            vectors = np.concatenate([np.pad(vectors, ((0, 0), (0, 1))), [[0.0, 0.0, 1.0]]])
            lengths = np.append(lengths, FAR)
        vectors = np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))
        return np.concatenate([vectors.ravel(), lengths])


class Solids(NamedTuple):
    """The kernels' view of some solids."""

    kind: Array  # (K,)
    begin: Array  # (K + 1,) where the numbers of a solid begin
    number: Array


own_symbols(Solids)


def make_solids(solids: Sequence[Solid]) -> Solids:
    """Return the kernels' view of solids."""
    numbers = [solid.numbers() for solid in solids]
    begin = np.cumsum([0, *map(len, numbers)]).astype(np.int64)
    kinds = np.array([solid.kind for solid in solids], np.int64)
    return Solids(kinds, begin, np.concatenate([np.zeros(0), *numbers]))


@kernel
def signed_distance(solids: Solids, k: int, x: Any) -> Any:
    """Return (d, n, alpha, t) of the k-th solid at x (3 numbers)."""
    kind, number, i = solids.kind[k], solids.number, solids.begin[k]
    if kind == PLANE:
        n = vector(number, i + 3)
        return dot(sub(x, vector(number, i)), n), n, 0.0, ZERO
    if kind == BOX:
        return of_box(number, i, x)
    if kind == CAPSULE:
        return of_capsule(number, i, x)
    if kind == CONE:
        return of_cone(number, i, x)
    if kind == TAPER:
        return of_taper(number, i, x)
    if kind == MESH:
        return of_mesh(number, i, x)
    # the others lie in a plane, with coordinates a and b
    offset, e, f = sub(x, vector(number, i)), vector(number, i + 3), vector(number, i + 6)
    a, b = dot(offset, e), dot(offset, f)
    first, last = i + 9, solids.begin[k + 1]
    if kind == POLYGON:
        d, n_a, n_b, alpha = of_polygon(number, first, last, a, b)
    elif kind == TERRAIN:
        d, n_a, n_b, alpha = of_terrain(number, first, last, a, b)
    else:
        d, n_a, n_b, alpha = of_hills(number[first], number[first + 1], number[first + 2], number[first + 3], a, b)
    return d, add(scale(e, n_a), scale(f, n_b)), alpha, cross(e, f)


@kernel
def cross(a: Any, b: Any) -> Any:
    """Return a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def of_box(number: Array, i: int, x: Any) -> Any:
    """Return those of a box: inside, the nearest face counts."""
    offset, outside, d, n = sub(x, vector(number, i)), 0.0, -FAR, ZERO
    for axis in range(3):
        e, half = vector(number, i + 3 + 3 * axis), number[i + 12 + axis]
        along = dot(offset, e)
        beyond = abs(along) - half
        outside += max(beyond, 0.0) ** 2
        if beyond > d:
            d, n = beyond, scale(e, 1.0 if along >= 0.0 else -1.0)
    return np.sqrt(outside) if outside > 0.0 else d, n, 0.0, ZERO


@kernel
def of_capsule(number: Array, i: int, x: Any) -> Any:
    """Return those of a capsule or a ball."""
    start, radius = vector(number, i), number[i + 6]
    offset, axis = sub(x, start), sub(vector(number, i + 3), start)
    length, at, t = np.sqrt(dot(axis, axis)), 0.0, ZERO
    if length > 0.0:
        at = min(max(dot(offset, axis) / length**2, 0.0), 1.0)
        if 0.0 < at < 1.0:
            t = scale(axis, 1.0 / length)
    arm = sub(offset, scale(axis, at))
    r = np.sqrt(dot(arm, arm))
    inverse = 1.0 / r if r > 0.0 else 0.0
    return r - radius, scale(arm, inverse), inverse, t


@kernel
def of_taper(number: Array, i: int, x: Any) -> Any:
    """Return those of a tapered capsule: of the ball, centred on the axis, that reaches farthest towards x."""
    start, low, high = vector(number, i), number[i + 6], number[i + 7]
    offset, axis = sub(x, start), sub(vector(number, i + 3), start)
    length = np.sqrt(dot(axis, axis))
    t = scale(axis, 1.0 / length)
    along = dot(offset, t)
    arm = sub(offset, scale(t, along))
    r = np.sqrt(dot(arm, arm))
    sine = (low - high) / length
    cosine = np.sqrt(1.0 - sine * sine)
    at = along - r * sine / cosine
    if 0.0 < at < length:
        inverse = 1.0 / r if r > 0.0 else 0.0
        out = scale(arm, inverse)
        n, along_side = add(scale(out, cosine), scale(t, sine)), sub(scale(t, cosine), scale(out, sine))
        return r * cosine + along * sine - low, n, cosine * inverse, along_side
    end = at >= length
    arm = sub(offset, scale(t, length if end else 0.0))
    r = np.sqrt(dot(arm, arm))
    inverse = 1.0 / r if r > 0.0 else 0.0
    return r - (high if end else low), scale(arm, inverse), inverse, ZERO


@kernel
def of_cone(number: Array, i: int, x: Any) -> Any:
    """Return those of a truncated cone: inside, the nearer of its side and its ends counts."""
    start, low, high = vector(number, i), number[i + 6], number[i + 7]
    offset, axis = sub(x, start), sub(vector(number, i + 3), start)
    length = np.sqrt(dot(axis, axis))
    t = scale(axis, 1.0 / length)
    along = dot(offset, t)
    arm = sub(offset, scale(t, along))
    r = np.sqrt(dot(arm, arm))
    # the side is (taper, 1) in the plane of r and t, and (1, -taper) is its normal
    taper = (high - low) / length
    slant = np.sqrt(1.0 + taper * taper)
    side, end = (r - low - taper * along) / slant, abs(along - 0.5 * length) - 0.5 * length
    if side > 0.0 or end > 0.0:
        at = min(max((along + taper * (r - low)) / (slant * slant), 0.0), length)
        to_side = (r - low - taper * at) ** 2 + (along - at) ** 2
        to_ends = min(max(r - low, 0.0) ** 2 + along**2, max(r - high, 0.0) ** 2 + (along - length) ** 2)
        return np.sqrt(min(to_side, to_ends)), t, 0.0, ZERO
    if side > end and r > 0.0:
        out = scale(arm, 1.0 / r)
        n, along_side = sub(out, scale(t, taper)), add(t, scale(out, taper))
        return side, scale(n, 1.0 / slant), 1.0 / (r * slant), scale(along_side, 1.0 / slant)
    return end, scale(t, 1.0 if along > 0.5 * length else -1.0), 0.0, ZERO


@kernel
def from_edge(number: Array, i: int, j: int, a: float, b: float) -> Any:
    """Return from the edge of corners i, j: the squared distance, the offset, and whether its inner part is nearest."""
    edge_a, edge_b = number[j] - number[i], number[j + 1] - number[i + 1]
    off_a, off_b = a - number[i], b - number[i + 1]
    square = edge_a * edge_a + edge_b * edge_b
    at = (off_a * edge_a + off_b * edge_b) / square if square > 0.0 else 0.0
    inner = 0.0 < at < 1.0
    at = min(max(at, 0.0), 1.0)
    off_a, off_b = off_a - at * edge_a, off_b - at * edge_b
    return off_a * off_a + off_b * off_b, off_a, off_b, inner


@kernel
def outward(number: Array, i: int, j: int, found: Any, inside: bool) -> Any:
    """Return (d, n_a, n_b, alpha) from what `from_edge` found at the nearest edge."""
    square, off_a, off_b, inner = found
    d = np.sqrt(square)
    sign = -1.0 if inside else 1.0
    if inner or d == 0.0:  # across the edge: the offset may be too short to have a direction
        n_a, n_b = number[j + 1] - number[i + 1], number[i] - number[j]
        length = np.sqrt(n_a * n_a + n_b * n_b)
        length = length if (off_a * n_a + off_b * n_b) * sign >= 0.0 else -length
        return sign * d, n_a / length, n_b / length, 0.0
    return sign * d, sign * off_a / d, sign * off_b / d, sign / d


@kernel
def of_polygon(number: Array, first: int, last: int, a: float, b: float) -> Any:
    """Return those of a polygon in its plane."""
    nearest, edge_i, edge_j, inside = from_edge(number, last - 2, first, a, b), last - 2, first, False
    for i in range(first, last, 2):
        j = i + 2 if i + 2 < last else first
        found = from_edge(number, i, j, a, b)
        if found[0] < nearest[0]:
            nearest, edge_i, edge_j = found, i, j
        if (number[i + 1] > b) != (number[j + 1] > b):
            height = (b - number[i + 1]) / (number[j + 1] - number[i + 1])
            if a < number[i] + height * (number[j] - number[i]):
                inside = not inside
    return outward(number, edge_i, edge_j, nearest, inside)


@kernel
def of_terrain(number: Array, first: int, last: int, a: float, b: float) -> Any:
    """Return those of a profile. No edge is nearer than the height above it, so only those around are looked at."""
    if a <= number[first]:
        low, height = first, number[first + 1]
    elif a >= number[last - 2]:
        low, height = last - 4, number[last - 1]
    else:
        low, high = first, last - 2
        while high - low > 2:
            middle = low + (high - low) // 4 * 2
            if number[middle] <= a:
                low = middle
            else:
                high = middle
        height = number[low + 1] + (number[low + 3] - number[low + 1]) * (a - number[low]) / (
            number[low + 2] - number[low]
        )
    above = b - height
    reach, inside = abs(above), above < 0.0
    # straight down, which is right on the level ends; the edges below are nearer elsewhere
    level = a <= number[first] or a >= number[last - 2]
    nearest, edge = (above * above if level else FAR, 0.0, above, True), -1
    i = low
    while i >= first and number[i + 2] >= a - reach:
        found = from_edge(number, i, i + 2, a, b)
        if found[0] < nearest[0]:
            nearest, edge = found, i
        i -= 2
    i = low + 2
    while i < last - 2 and number[i] <= a + reach:
        found = from_edge(number, i, i + 2, a, b)
        if found[0] < nearest[0]:
            nearest, edge = found, i
        i += 2
    if edge < 0:
        return above, 0.0, 1.0, 0.0
    return outward(number, edge, edge + 2, nearest, inside)


@kernel
def of_hills(amplitude: float, wavelength: float, base: float, phase: float, a: float, b: float) -> Any:
    """Return those of a sinusoid: the nearest point by Newton's method; far from the surface, a bound."""
    k = 2.0 * np.pi / wavelength
    above = b - base - amplitude * np.sin(k * a + phase)
    steepest, sharpest = amplitude * k, amplitude * k * k
    if abs(above) * sharpest > 0.25:
        return above / np.sqrt(1.0 + steepest * steepest), 0.0, 1.0, 0.0
    at, slope, bend = a, 0.0, 0.0
    for _ in range(20):
        angle = k * at + phase
        slope, bend = steepest * np.cos(angle), -sharpest * np.sin(angle)
        over = b - base - amplitude * np.sin(angle)
        curve = 1.0 + slope * slope - over * bend
        at += ((a - at) + over * slope) / max(curve, 0.5)
    angle = k * at + phase
    slope, bend = steepest * np.cos(angle), -sharpest * np.sin(angle)
    r = np.sqrt(1.0 + slope * slope)
    n_a, n_b = -slope / r, 1.0 / r
    d = (a - at) * n_a + (b - base - amplitude * np.sin(angle)) * n_b
    curvature = bend / r**3
    return d, n_a, n_b, -curvature / (1.0 - curvature * d)
