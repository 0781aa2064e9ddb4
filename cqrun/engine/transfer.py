"""Transfers between particles and grid: a scatter, a gather, and the gather of their adjoints.

P2G and the adjoint of G2P scatter an affine field of each particle to the 3^D nodes of its stencil,

    grid_n += sum_p w_np (a_p + B_p (o_n - f_p)),

and G2P and the adjoint of P2G gather the moments sum_n w g_n and sum_n w g_n (o_n - f_p)^T. o_n in {0, 1, 2}^D is the
node's place in the stencil, f in [1/2, 3/2]^D the particle's, both in cells. Weights: quadratic B-splines,
1/2 (3/2 - f)^2, 3/4 - (f - 1)^2, 1/2 (f - 1/2)^2 (CQ1 eq 3).

A node is a record of 4: three components and the mass. In 2D a record is (v_x, v_y, 0, m), and a position (-, x, y, -),
so that the last axis is entry 2 in both dimensions. A substep's adjoint scatters both fields at once, because their
weights and nodes are the same: there each node has two records, one after the other (`Work.both`).

Arrays of records: `value` (n, 4) has a_p - B_p f_p, `affine` (3 n, 4) the columns of B_p, axis by axis, and `place`
(n, 4) the position in cells. Particles whose stencils do not change have those in place of positions (stencils.py).
"""

from __future__ import annotations

from typing import Any

from cqrun.engine.stencils import Stencils, node_of, pairs_at, records_at, row_of, stencil, stencils
from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import lane
from cqrun.numerics.records import load4, store4
from cqrun.numerics.wide_records import (
    filled,
    load_each,
    load_neighbours,
    load_pairs,
    load_wide,
    prefetch_each,
    records_in_lane,
    spread,
    store_neighbours,
    store_wide,
    sums,
)
from cqrun.plugin.contract import Array

AHEAD = 16
"""How many particles ahead `scatter` prefetches: the particles of a colour's blocks are far apart in memory."""


@kernel
def weights(f: Any) -> Any:
    """Return the spline's three weights at f."""
    a, b, c = 1.5 - f, f - 1.0, f - 0.5
    return 0.5 * a * a, 0.75 - b * b, 0.5 * c * c


@kernel
def slopes(f: Any) -> Any:
    """Return the derivatives of the three weights by f."""
    return f - 1.5, 2.0 - 2.0 * f, f - 0.5


@kernel
def prefetch_fields(place: Array, values: Any, affines: Any, p: int, n: int, in_3d: bool) -> None:
    """Prefetch the records that `scatter` reads for particle p of n."""
    prefetch_each((place,), p)
    prefetch_each(values, p)
    if in_3d:
        prefetch_each(affines, p)
    prefetch_each(affines, n + p)
    prefetch_each(affines, 2 * n + p)


@kernel
def scatter(
    grid: Array, values: Any, affines: Any, place: Array, order: Array, lo: int, hi: int, strides: Any, dims: Any
) -> None:
    """Add the affine fields of particles order[lo:hi] to the grid.

    Args:
        grid: (nodes, 4), or (2 nodes, 4) for two fields: the records of a node one after the other.
        values, affines: tuples with one array per field.
    """
    n, in_3d = values[0].shape[0], len(dims) == 3
    for index in range(lo, hi):
        p = order[index]
        prefetch_fields(place, values, affines, order[min(index + AHEAD, n - 1)], n, in_3d)
        first, f = stencil(place, p, strides)
        spread_out(grid, values, affines, place, p, n, first, f, strides, in_3d)


@kernel
def scatter_tile(
    grid: Array, values: Any, affines: Any, place: Stencils, lo: int, hi: int, strides: Any, dims: Any
) -> None:
    """Add the affine fields of particles lo:hi, which are in tile arrays, to the grid; see `scatter`."""
    n, in_3d = values[0].shape[0], len(dims) == 3
    for p in range(lo, hi):
        first, f = stencil(place, p, strides)
        spread_out(grid, values, affines, place, p - lo, n, first, f, strides, in_3d)


@kernel
def spread_out(
    grid: Array, values: Any, affines: Any, place: Any, p: int, n: int, first: int, f: Any, strides: Any, in_3d: bool
) -> None:
    """Add the affine fields in entry p of the arrays to the stencil that begins at `first`."""
    W = weights(f)
    w0, w1, w2 = lane(W[0], 2), lane(W[1], 2), lane(W[2], 2)
    a = load_each(values, p)
    b0, b1, b2 = load_each(affines, p), load_each(affines, n + p), load_each(affines, 2 * n + p)
    c1, c2 = b2 * w1, (b2 + b2) * w2
    for i in range(3 if in_3d else 1):
        w_i = lane(W[i], 0) if in_3d else 1.0
        a_i = a + b0 * i if in_3d else a
        for j in range(3):
            w = w_i * lane(W[j], 1)
            a_j = a_i + b1 * j
            n0, n1, n2 = row_of(place, first, i, j, strides)
            store_wide(grid, n0, load_wide(grid, n0, a) + a_j * w0 * w)
            store_wide(grid, n1, load_wide(grid, n1, a) + (a_j * w1 + c1) * w)
            store_wide(grid, n2, load_wide(grid, n2, a) + (a_j * w2 + c2) * w)


@kernel
def gather(grid: Array, place: Array, value: Array, moment: Array, lo: int, hi: int, strides: Any, dims: Any) -> None:
    """Gather particles lo:hi into `value` (tile, 4), sum w g, and `moment` (3 tile, 4), sum w g (o - f)^T axis by axis.

    Each step handles one particle for each record in a lane value; hi - lo is a multiple of their number.
    """
    n, in_3d = value.shape[0], len(dims) == 3
    zero, one = filled(0.0, grid), filled(1.0, grid)
    for p in range(lo, hi, records_in_lane(grid)):
        nodes, f = stencils(place, p, strides)
        W = weights(f)
        w0, w1, w2 = spread(W[0], 2), spread(W[1], 2), spread(W[2], 2)
        v, m0, m1, m2 = zero, zero, zero, zero
        # sums over k, then j, then i: 93 multiply-adds instead of 27 * 4
        for i in range(3 if in_3d else 1):
            w_i = spread(W[i], 0) if in_3d else one
            s, s1, s2 = zero, zero, zero
            for j in range(3):
                w_j = spread(W[j], 1)
                g1 = records_at(grid, place, nodes, i, j, 1, strides) * w1
                g2 = records_at(grid, place, nodes, i, j, 2, strides) * w2
                r = records_at(grid, place, nodes, i, j, 0, strides) * w0 + g1 + g2
                s = s + r * w_j
                s1 = s1 + r * (w_j * j)
                s2 = s2 + (g1 + g2 * 2.0) * w_j
            v = v + s * w_i
            m0 = m0 + s * (w_i * i)
            m1 = m1 + s1 * w_i
            m2 = m2 + s2 * w_i
        store_neighbours(value, p - lo, v)
        store_neighbours(moment, p - lo, m0 - v * spread(f, 0))
        store_neighbours(moment, n + p - lo, m1 - v * spread(f, 1))
        store_neighbours(moment, 2 * n + p - lo, m2 - v * spread(f, 2))


@kernel
def gather_both(
    pairs: Array, place: Any, moment: Array, moment_2: Array, lo: int, hi: int, strides: Any, dims: Any
) -> None:
    """Gather the moments of two fields, whose records at a node follow each other in `pairs`; see `gather`."""
    n, in_3d = moment.shape[0] // 3, len(dims) == 3
    zero, one = filled(0.0, pairs), filled(1.0, pairs)
    for p in range(lo, hi, records_in_lane(pairs)):
        nodes, f = stencils(place, p, strides)
        W = weights(f)
        w0, w1, w2 = spread(W[0], 2), spread(W[1], 2), spread(W[2], 2)
        v, m0, m1, m2, u, l0, l1, l2 = zero, zero, zero, zero, zero, zero, zero, zero
        for i in range(3 if in_3d else 1):
            w_i = spread(W[i], 0) if in_3d else one
            s, s1, s2, t, t1, t2 = zero, zero, zero, zero, zero, zero
            for j in range(3):
                w_j = spread(W[j], 1)
                g0, h0 = pairs_at(pairs, place, nodes, i, j, 0, strides)
                g1, h1 = pairs_at(pairs, place, nodes, i, j, 1, strides)
                g2, h2 = pairs_at(pairs, place, nodes, i, j, 2, strides)
                g1, g2, h1, h2 = g1 * w1, g2 * w2, h1 * w1, h2 * w2
                g, h = g0 * w0 + g1 + g2, h0 * w0 + h1 + h2
                s, t = s + g * w_j, t + h * w_j
                s1, t1 = s1 + g * (w_j * j), t1 + h * (w_j * j)
                s2, t2 = s2 + (g1 + g2 * 2.0) * w_j, t2 + (h1 + h2 * 2.0) * w_j
            v, u = v + s * w_i, u + t * w_i
            m0, l0 = m0 + s * (w_i * i), l0 + t * (w_i * i)
            m1, l1 = m1 + s1 * w_i, l1 + t1 * w_i
            m2, l2 = m2 + s2 * w_i, l2 + t2 * w_i
        f0, f1, f2 = spread(f, 0), spread(f, 1), spread(f, 2)
        store_neighbours(moment, p - lo, m0 - v * f0)
        store_neighbours(moment, n + p - lo, m1 - v * f1)
        store_neighbours(moment, 2 * n + p - lo, m2 - v * f2)
        store_neighbours(moment_2, p - lo, l0 - u * f0)
        store_neighbours(moment_2, n + p - lo, l1 - u * f1)
        store_neighbours(moment_2, 2 * n + p - lo, l2 - u * f2)


@kernel
def gather_vjp(
    grid: Array, fields: Any, fields_2: Any, place: Array, value: Array, moment: Array, slope: Array, lo: int, hi: int,
    strides: Any, dims: Any,
) -> None:  # fmt: skip
    """Gather the adjoints of P2G and G2P for particles lo:hi into tile arrays, as in `gather`.

    The two records of a node are its velocity v_n and the cotangent g_n of its momentum and mass. `value` and `moment`
    are those of g_n. `slope` (tile, 4) is the derivative by the position in cells, through the weights only, of
    sum_n w (g_n . P2G's field) + sum_n w (v_n . the field of the adjoint of G2P). `fields` is P2G's field as (value,
    affine), `fields_2` that of the adjoint of G2P.
    """
    n, m, in_3d = value.shape[0], place.shape[0], len(dims) == 3
    zero, one = filled(0.0, grid), filled(1.0, grid)
    for p in range(lo, hi, records_in_lane(grid)):
        nodes, f = stencils(place, p, strides)
        W, S = weights(f), slopes(f)
        w0, w1, w2 = spread(W[0], 2), spread(W[1], 2), spread(W[2], 2)
        d0, d1, d2 = spread(S[0], 2), spread(S[1], 2), spread(S[2], 2)
        a, b0 = load_neighbours(fields[0], p), load_neighbours(fields[1], p)
        b1, b2 = load_neighbours(fields[1], m + p), load_neighbours(fields[1], 2 * m + p)
        e, c0 = load_neighbours(fields_2[0], p), load_neighbours(fields_2[1], p)
        c1, c2 = load_neighbours(fields_2[1], m + p), load_neighbours(fields_2[1], 2 * m + p)
        v, m0, m1, m2, x0, x1, x2 = zero, zero, zero, zero, zero, zero, zero
        for i in range(3 if in_3d else 1):
            w_i, d_i = (spread(W[i], 0), spread(S[i], 0)) if in_3d else (one, zero)
            s, s1, s2, h, h1, h2 = zero, zero, zero, zero, zero, zero
            a_i, e_i = (a + b0 * i, e + c0 * i) if in_3d else (a, e)
            for j in range(3):
                w_j, d_j = spread(W[j], 1), spread(S[j], 1)
                node = i * strides[0] + j * strides[1]
                a_j, e_j = a_i + b1 * j, e_i + c1 * j
                u0, g0 = load_pairs(grid, nodes, node)
                u1, g1 = load_pairs(grid, nodes, node + 1)
                u2, g2 = load_pairs(grid, nodes, node + 2)
                # the four entries of the scalar product <g, field>, which are summed at the end
                t0 = g0 * a_j + u0 * e_j
                a_j, e_j = a_j + b2, e_j + c2
                t1 = g1 * a_j + u1 * e_j
                a_j, e_j = a_j + b2, e_j + c2
                t2 = g2 * a_j + u2 * e_j
                t = t0 * w0 + t1 * w1 + t2 * w2
                h = h + t * w_j
                h1 = h1 + t * d_j
                h2 = h2 + (t0 * d0 + t1 * d1 + t2 * d2) * w_j
                g1, g2 = g1 * w1, g2 * w2
                r = g0 * w0 + g1 + g2
                s = s + r * w_j
                s1 = s1 + r * (w_j * j)
                s2 = s2 + (g1 + g2 * 2.0) * w_j
            v = v + s * w_i
            m0 = m0 + s * (w_i * i)
            m1 = m1 + s1 * w_i
            m2 = m2 + s2 * w_i
            x0 = x0 + h * d_i
            x1 = x1 + h1 * w_i
            x2 = x2 + h2 * w_i
        store_neighbours(value, p - lo, v)
        store_neighbours(moment, p - lo, m0 - v * spread(f, 0))
        store_neighbours(moment, n + p - lo, m1 - v * spread(f, 1))
        store_neighbours(moment, 2 * n + p - lo, m2 - v * spread(f, 2))
        store_neighbours(slope, p - lo, sums(x0, x1, x2))


@kernel
def gather_slopes(
    out: Array, grid: Array, stride: int, first: int, value: Array, affine: Array, place: Stencils, lo: int, hi: int,
    strides: Any, dims: Any,
) -> None:  # fmt: skip
    """Add to the records `out` of particles lo:hi the derivative by f of sum_n w g_n . (a + B (o - f)).

    Through weights and arms, with the fields held that are in tile arrays, as for `scatter_tile`. Node n has record
    n * stride + first of the grid.
    """
    n, in_3d = value.shape[0], len(dims) == 3
    for p in range(lo, hi):
        node, f = stencil(place, p, strides)
        W, S = weights(f), slopes(f)
        w0, w1, w2 = lane(W[0], 2), lane(W[1], 2), lane(W[2], 2)
        d0, d1, d2 = lane(S[0], 2), lane(S[1], 2), lane(S[2], 2)
        a = load4(value, p - lo)
        b0, b1, b2 = load4(affine, p - lo), load4(affine, n + p - lo), load4(affine, 2 * n + p - lo)
        v, x0, x1, x2 = a * 0.0, a * 0.0, a * 0.0, a * 0.0
        for i in range(3 if in_3d else 1):
            w_i, d_i = (lane(W[i], 0), lane(S[i], 0)) if in_3d else (1.0, 0.0)
            a_i = a + b0 * i if in_3d else a
            for j in range(3):
                w_j, d_j = lane(W[j], 1), lane(S[j], 1)
                g0 = load4(grid, node_of(place, node, i, j, 0, strides) * stride + first)
                g1 = load4(grid, node_of(place, node, i, j, 1, strides) * stride + first)
                g2 = load4(grid, node_of(place, node, i, j, 2, strides) * stride + first)
                a_j = a_i + b1 * j
                t0, t1, t2 = g0 * a_j, g1 * (a_j + b2), g2 * (a_j + b2 + b2)
                t = t0 * w0 + t1 * w1 + t2 * w2
                v = v + (g0 * w0 + g1 * w1 + g2 * w2) * (w_i * w_j)
                x0 = x0 + t * (d_i * w_j)
                x1 = x1 + t * (w_i * d_j)
                x2 = x2 + (t0 * d0 + t1 * d1 + t2 * d2) * (w_i * w_j)
        of_axis_0 = x0 - b0 * v if in_3d else x0
        store4(out, p, load4(out, p) + sums(of_axis_0, x1 - b1 * v, x2 - b2 * v))
