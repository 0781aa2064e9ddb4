"""The point of a segment or a triangle that is nearest to a position, and how it follows the vertices.

A nearest point c = sum_v l_v x_v has weights l_v >= 0 that sum to 1. Those of some vertices may be zero: then it lies
on an edge or at a vertex, and the others determine it alone. With the offset g = x - c, the edges E_j = x_j - x_0 of
those others, and G_jk = E_j . E_k, it follows from E_j . g = 0 that G dl = E^T d + dE^T g, d = dx - sum_v l_v dx_v.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.boundaries.solid import ZERO, cross
from cqrun.numerics.compile import kernel
from cqrun.numerics.tensor import add, dot, scale, sub
from cqrun.plugin.contract import Array

SAME = 1e-9
"""Relative difference of squared distances up to which two facets are equally near, as at a common edge."""


@kernel
def row(a: Array, i: int) -> Any:
    """Return a vector of an array (n, 3)."""
    return a[i, 0], a[i, 1], a[i, 2]


@kernel
def on_segment(x: Any, a: Any, b: Any) -> float:
    """Return the weight of b in the point of a segment that is nearest to x."""
    edge = sub(b, a)
    square = dot(edge, edge)
    return min(max(dot(sub(x, a), edge) / square, 0.0), 1.0) if square > 0.0 else 0.0


@kernel
def on_triangle(x: Any, a: Any, b: Any, c: Any) -> Any:
    """Return the three weights of the point of a triangle that is nearest to x (C. Ericson, Real-Time Collision
    Detection, 2005, section 5.1.5)."""
    ab, ac, ap = sub(b, a), sub(c, a), sub(x, a)
    d1, d2 = dot(ab, ap), dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    bp = sub(x, b)
    d3, d4 = dot(ab, bp), dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        t = d1 / (d1 - d3)
        return 1.0 - t, t, 0.0
    cp = sub(x, c)
    d5, d6 = dot(ab, cp), dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        t = d2 / (d2 - d6)
        return 1.0 - t, 0.0, t
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - t, t
    total = va + vb + vc
    return va / total, vb / total, vc / total


@kernel
def nearest_on(facets: Array, f: int, x: Any, place: Array) -> Any:
    """Return the weights of a facet's vertices (3), and the square of the distance from x; vertices are at `place`."""
    a, b = row(place, facets[f, 0]), row(place, facets[f, 1])
    if facets.shape[1] == 2:
        t = on_segment(x, a, b)
        weights = (1.0 - t, t, 0.0)
        g = sub(x, add(scale(a, 1.0 - t), scale(b, t)))
        return weights, dot(g, g)
    c = row(place, facets[f, 2])
    weights = on_triangle(x, a, b, c)
    g = sub(x, add(add(scale(a, weights[0]), scale(b, weights[1])), scale(c, weights[2])))
    return weights, dot(g, g)


@kernel
def above(facets: Array, f: int, x: Any, place: Array) -> float:
    """Return the signed distance of x from a facet's line or plane."""
    a, b = row(place, facets[f, 0]), row(place, facets[f, 1])
    edge = sub(b, a)
    other = sub(row(place, facets[f, 2]), a) if facets.shape[1] == 3 else (0.0, 0.0, 1.0)
    n = cross(edge, other)
    length = np.sqrt(dot(n, n))
    return dot(sub(x, a), n) / length if length > 0.0 else 0.0


@kernel
def mean_of(facets: Array, f: int, weights: Any, value: Array) -> Any:
    """Return sum_v l_v of a facet's vertices."""
    out = add(scale(row(value, facets[f, 0]), weights[0]), scale(row(value, facets[f, 1]), weights[1]))
    if facets.shape[1] == 3:
        out = add(out, scale(row(value, facets[f, 2]), weights[2]))
    return out


@kernel
def free_vertices(weights: Any) -> Any:
    """Return the numbers of the vertices with weight, at most three, and how many they are."""
    first, second, third, count = 0, 0, 0, 0
    for v in range(3):
        if weights[v] > 0.0:
            if count == 0:
                first = v
            elif count == 1:
                second = v
            else:
                third = v
            count += 1
    return first, second, third, count


@kernel
def solve_edges(p: Any, q: Any, a: float, b: float, count: int) -> Any:
    """Return (s, t) of G (s, t) = (a, b), with G of the first count - 1 of the edges p, q."""
    if count == 1:
        return 0.0, 0.0
    pp = dot(p, p)
    if count == 2:
        return a / pp, 0.0
    pq, qq = dot(p, q), dot(q, q)
    whole = pp * qq - pq * pq
    return (qq * a - pq * b) / whole, (pp * b - pq * a) / whole


@kernel
def nearest_vjp(facets: Array, f: int, weights: Any, place: Array, g: Any, weights_bar: Any, g_bar: Any) -> Any:
    """Return the cotangents of x and of the three vertices from those of the weights and of g = x - c."""
    i, j, k, count = free_vertices(weights)
    base = row(place, facets[f, i])
    p = sub(row(place, facets[f, j]), base) if count > 1 else ZERO
    q = sub(row(place, facets[f, k]), base) if count > 2 else ZERO
    s, t = solve_edges(
        p, q, weights_bar[j] - weights_bar[i] - dot(p, g_bar), weights_bar[k] - weights_bar[i] - dot(q, g_bar), count
    )
    x_bar = add(g_bar, add(scale(p, s), scale(q, t)))
    out_i = add(scale(x_bar, -weights[i]), scale(g, -s - t))
    out_j = add(scale(x_bar, -weights[j]), scale(g, s)) if count > 1 else ZERO
    out_k = add(scale(x_bar, -weights[k]), scale(g, t)) if count > 2 else ZERO
    return (
        x_bar,
        of_vertex(0, i, j, k, count, out_i, out_j, out_k),
        of_vertex(1, i, j, k, count, out_i, out_j, out_k),
        of_vertex(2, i, j, k, count, out_i, out_j, out_k),
    )


@kernel
def of_vertex(v: int, i: int, j: int, k: int, count: int, out_i: Any, out_j: Any, out_k: Any) -> Any:
    """Return what belongs to vertex v of the free vertices i, j, k; zero if it is none of them."""
    if v == i:
        return out_i
    if count > 1 and v == j:
        return out_j
    return out_k if count > 2 and v == k else ZERO
