"""The signed distance from a closed triangle mesh: the nearest triangle in a tree of boxes, and its side.

The numbers of a mesh, in its own coordinates and without a unit, after a scale [m]:

    tolerance         distance within which two nearest points are one, and a point is on a triangle
    count, depth      of triangles, and of the tree, whose 2^depth leaves share the triangles evenly, in order
    boxes             6 for each node, its lower and its upper corner. Node k has the children 2 k and 2 k + 1; 1 is the
                      root
    triangles         15 each: the corner a, the unit vectors e along its longest edge from a to b, f across it and the
                      normal n = e x f, then |b - a|, and the coordinates of the third corner c along e and f
    normals           18 each, of which only the direction counts: of the edges ab, bc, ca and of the corners a, b, c

The side follows from the sign of N . (x - y) at the nearest point y, where N is the normal of the triangle, the sum of
both normals of an edge, or the sum of those around a corner, each times its angle there (J. A. Baerentzen and
H. Aanaes, IEEE Trans. Vis. Comput. Graph. 11 (2005)).

A tree that halves evenly needs no links and, to come back from a leaf, no stack but a bit for each level (R. Barringer
and T. Akenine-Moeller, J. Comput. Graph. Tech. 2 (2013)): kernels allocate nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.numerics.compile import kernel, one_body
from cqrun.numerics.tensor import add, dot, scale, sub, vector
from cqrun.plugin.contract import Array

HEAD, BOX, TRIANGLE, NORMALS = 4, 6, 15, 18
"""Numbers of the head (with the scale), of a box, of a triangle and of its normals."""

FACE = 0
"""What is nearest: this, an edge ab, bc, ca (1 to 3), or a corner a, b, c (4 to 6)."""

OPPOSITE = 1e-12
"""Relative difference of squares up to which a corner is not nearer than the inner part of an edge: of rounding."""


@one_body
def of_mesh(number: Array, i: int, x: Any) -> Any:
    """Return (d, n, alpha, t) of a mesh at x; see `solid.signed_distance`.

    Outside the box around all of it, d is the distance from that box. `i` is where its origin begins; three unit
    vectors and the numbers follow.
    """
    axes, head = (vector(number, i + 3), vector(number, i + 6), vector(number, i + 9)), i + 12
    unit, tolerance, count, depth = number[head], number[head + 1], int(number[head + 2]), int(number[head + 3])
    boxes = head + HEAD
    triangles = boxes + BOX * ((2 << depth) - 1)
    offset = sub(x, vector(number, i))
    p = (dot(offset, axes[0]) / unit, dot(offset, axes[1]) / unit, dot(offset, axes[2]) / unit)
    outside = from_box(number, boxes, 1, p)
    if outside > 0.0:
        return unit * np.sqrt(outside), axes[0], 0.0, (0.0, 0.0, 0.0)
    k = nearest(number, boxes, triangles, count, depth, tolerance, p)
    d, n, alpha, t = of_triangle(number, triangles + TRIANGLE * k, triangles + TRIANGLE * count + NORMALS * k,
                                 tolerance, p)  # fmt: skip
    return unit * d, turned(axes, n), alpha / unit, turned(axes, t)


@kernel
def turned(axes: Any, a: Any) -> Any:
    """Return a vector of the mesh's coordinates in the world."""
    return add(add(scale(axes[0], a[0]), scale(axes[1], a[1])), scale(axes[2], a[2]))


@kernel
def from_box(number: Array, boxes: int, node: int, p: Any) -> float:
    """Return the squared distance of a point from the box of a node; zero inside."""
    low, square = boxes + BOX * (node - 1), 0.0
    for axis in range(3):
        beyond = max(max(number[low + axis] - p[axis], p[axis] - number[low + 3 + axis]), 0.0)
        square += beyond * beyond
    return square


@kernel
def nearest(number: Array, boxes: int, triangles: int, count: int, depth: int, tolerance: float, p: Any) -> int:
    """Return the triangle nearest to a point.

    Of those that are equally near, to the tolerance, it is one with p above its face, or else above an edge, so that p
    is above a corner or a seam of a plane part only if nothing else is right.
    """
    leaves, node, trail = 1 << depth, 1, 0  # bits of the trail: whether the other child must still be looked at
    found, best, kind, slack = 0, np.inf, 3, 0.0
    while True:
        if node < leaves:
            left, right = from_box(number, boxes, 2 * node, p), from_box(number, boxes, 2 * node + 1, p)
            if min(left, right) <= best + slack:
                trail = 2 * trail + (1 if max(left, right) <= best + slack else 0)
                node = 2 * node + (1 if right < left else 0)
                continue
        else:
            for k in range((count * (node - leaves)) >> depth, (count * (node - leaves + 1)) >> depth):
                square, what, _, _, _ = on_triangle(number, triangles + TRIANGLE * k, tolerance, best + slack, p)
                rank = (what + 2) // 3
                if square < best - slack or (square <= best + slack and rank < kind):
                    found, best, kind = k, square, rank
                    slack = tolerance * (2.0 * np.sqrt(best) + tolerance)
        # up, and to the last other child that may be nearer
        while True:
            while trail != 0 and trail % 2 == 0:
                node, trail = node >> 1, trail >> 1
            if trail == 0:
                return found
            node, trail = node ^ 1, trail - 1
            if from_box(number, boxes, node, p) <= best + slack:
                break


@kernel
def on_triangle(number: Array, at: int, tolerance: float, limit: float, p: Any) -> Any:
    """Return the squared distance of a point from a triangle, what is nearest, and the offset along e, f and n.

    Those farther than the square `limit` may be told as infinitely far.
    """
    offset = sub(p, vector(number, at))
    w = dot(offset, vector(number, at + 9))
    if w * w > limit:
        return np.inf, FACE, 0.0, 0.0, w
    u, v = dot(offset, vector(number, at + 3)), dot(offset, vector(number, at + 6))
    b, c_u, c_v = number[at + 12], number[at + 13], number[at + 14]
    # a triangle without a height has no face
    if c_v > 0.0 and v >= 0.0 and (c_u - b) * v >= c_v * (u - b) and c_v * u >= c_u * v:
        return w * w, FACE, 0.0, 0.0, w
    key, square, what, du, dv = on_edge(u, v, 0.0, 0.0, b, 0.0, tolerance, 1, 4, 5)
    found = on_edge(u, v, b, 0.0, c_u, c_v, tolerance, 2, 5, 6)
    if found[0] < key:
        key, square, what, du, dv = found
    found = on_edge(u, v, c_u, c_v, 0.0, 0.0, tolerance, 3, 6, 4)
    if found[0] < key:
        key, square, what, du, dv = found
    if c_v > 0.0 and square <= tolerance * tolerance:
        return w * w, FACE, 0.0, 0.0, w
    return square + w * w, what, du, dv, w


@kernel
def on_edge(
    u: float, v: float, a_u: float, a_v: float, b_u: float, b_v: float, tolerance: float, edge: int, a: int, b: int
) -> Any:  # fmt: skip
    """Return a number to compare, the squared distance in the plane, what is nearest, and the offset from it."""
    e_u, e_v = b_u - a_u, b_v - a_v
    along = e_u * e_u + e_v * e_v
    t = ((u - a_u) * e_u + (v - a_v) * e_v) / along
    at = min(max(t, 0.0), 1.0)
    du, dv = u - a_u - at * e_u, v - a_v - at * e_v
    square, over = du * du + dv * dv, (t - at) * (t - at) * along
    if over <= tolerance * tolerance:
        return square, square, edge, du, dv
    return square * (1.0 + OPPOSITE) + 2.0 * tolerance * tolerance, square, a if t < 0.0 else b, du, dv


@kernel
def of_triangle(number: Array, at: int, normals: int, tolerance: float, p: Any) -> Any:
    """Return (d, n, alpha, t) at a point whose nearest triangle this is."""
    square, what, du, dv, w = on_triangle(number, at, tolerance, np.inf, p)
    e, f, n = vector(number, at + 3), vector(number, at + 6), vector(number, at + 9)
    nothing = (0.0, 0.0, 0.0)
    if what == FACE:
        return w, n, 0.0, nothing
    offset = add(add(scale(e, du), scale(f, dv)), scale(n, w))
    d = np.sqrt(square)
    if d == 0.0:  # on a triangle without a height
        return d, n, 0.0, nothing
    side = -1.0 if dot(offset, vector(number, normals + 3 * (what - 1))) < 0.0 else 1.0
    t = nothing
    if what < 4:
        b, c_u, c_v = number[at + 12], number[at + 13], number[at + 14]
        t_u = b if what == 1 else (c_u - b if what == 2 else c_u)
        t_v = 0.0 if what == 1 else c_v
        length = np.sqrt(t_u * t_u + t_v * t_v)
        t = add(scale(e, t_u / length), scale(f, t_v / length))
    return side * d, scale(offset, side / d), side / d, t
