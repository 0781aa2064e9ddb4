"""The tangent of the internal forces at a displacement, and its product with a displacement.

Each particle keeps the second derivative of its energy, A = dP/dF, a symmetric matrix of D^2 rows (Q is row-major). Its
column for a unit Q follows from the adjoint of the stress, because A is symmetric: with G = F^-1, P = tau F^-T,

    A : Q = kirchhoff_vjp(F, tau_bar = Q G).F_bar - G^T Q^T P.

With averaged volumes A keeps the mean pressures; what they change by is a matrix of its own (`volumes.py`).

It is the same for every law, so a product costs the same too: gather Q = sum_n w p_n d^T, scatter A : Q.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import overload, register_jitable

from cqrun.engine.arrays import get_columns, load_F
from cqrun.engine.reference.fields import put_linear
from cqrun.engine.reference.setting import TILE, NodeRun
from cqrun.engine.reference.volume import average_each, collect_pressures, with_mean, with_mean_slope
from cqrun.engine.setting import Crew, Group
from cqrun.engine.stencils import node_of
from cqrun.engine.transfer import gather, scatter_tile
from cqrun.materials.stress import stress_slope, total_kirchhoff
from cqrun.materials.term import zeros_like_rows
from cqrun.numerics.compile import allocating_kernel, barrier, for_each, kernel, share, written
from cqrun.numerics.lanes import LANE_BYTES
from cqrun.numerics.packed import load, store
from cqrun.numerics.tensor import cofactor, det, mul, mul_at, mul_bt, scale, sub
from cqrun.plugin.contract import Array
from cqrun.state import VOLUME


def rows_of(dim: int) -> int:
    """Return the number of different entries of A."""
    return dim**2 * (dim**2 + 1) // 2


def unit_like(F: Any, k: int) -> Any:
    """Return the matrix whose entry k is 1, of the type of F."""
    return tuple(entry * 0.0 + float(k == m) for m, entry in enumerate(F))


@overload(unit_like)
def _unit_like(F, k):
    entries = "".join(f"F[{m}] * 0.0 + (1.0 if k == {m} else 0.0), " for m in range(len(F)))
    return written(f"lambda F, k: ({entries})")


@register_jitable
def store_lower(A: Array, k: int, m: int, i: int, value: Any) -> None:
    """Write entry (k, m) of A, m <= k, of the lane of particles at i."""
    if m <= k:
        store(A, k * (k + 1) // 2 + m, i, value)


def put_row(A: Array, k: int, i: int, row: Any) -> None:
    """Write row k of A."""
    for m, value in enumerate(row):
        store_lower(A, k, m, i, value)


@overload(put_row)
def _put_row(A, k, i, row):
    entries = "".join(f"store_lower(A, k, {m}, i, row[{m}]), " for m in range(len(row)))
    return written(f"lambda A, k, i, row: ({entries})", {"store_lower": store_lower})


def row_number(k: int, m: int) -> int:
    """Return the row of entry (k, m) in the table of A."""
    k, m = max(k, m), min(k, m)
    return k * (k + 1) // 2 + m


def times(A: Array, i: int, Q: Any) -> Any:
    """Return A : Q of the lane of particles at i."""
    n = len(Q)
    return tuple(sum(load(A, row_number(k, m), i) * Q[m] for m in range(n)) for k in range(n))


@overload(times)
def _times(A, i, Q):
    n = len(Q)
    sums = (" + ".join(f"load(A, {row_number(k, m)}, i) * Q[{m}]" for m in range(n)) for k in range(n))
    return written(f"lambda A, i, Q: ({''.join(each + ', ' for each in sums)})", {"load": load})


@kernel
def find_tangent(
    part: tuple[Group, Any, int, int], run: NodeRun, A: Array, u: Array, colours: Array, crew: Crew
) -> None:
    """Write vol0 A of a group's particles, with mean pressures kept; `run.q` has their F."""
    group, means, first, last = part
    average_each(means, run, u, first, last, colours, crew)
    dims, width = run.setting.dims, LANE_BYTES // run.fields.itemsize
    lo, hi = share((group.hi - group.lo) // width, crew.thread, crew.n_threads)
    for lane in range(lo, hi):
        i = group.lo + lane * width
        F = load_F(run.q, i, dims)
        none, Gt = zeros_like_rows(F), scale(cofactor(F), 1.0 / det(F))
        collect_pressures(means, run, i, i + width, crew.thread)
        P = mul(with_mean(means, total_kirchhoff(group.terms, run.q, run.q, i, F, none, 0.0), F, i, 0, crew.thread), Gt)
        vol = load(run.fields, VOLUME, i)
        for k in range(len(F)):
            Q = unit_like(F, k)
            tau_bar = mul_bt(Q, Gt)
            F_bar = stress_slope(group.terms, i, F, none, tau_bar)
            F_bar = with_mean_slope(means, F_bar, F, tau_bar, i, 0, crew.thread)
            put_row(A, k, i, scale(sub(F_bar, mul(Gt, mul_at(Q, P))), vol))


@kernel
def stiffen(run: NodeRun, A: Array, p: Array, colours: Array, crew: Crew) -> None:
    """Add the change of the internal forces with a displacement p of the nodes to `run.force`: -sum vol0 (A : Q) d."""
    for body in range(colours.shape[0]):
        for colour in range(8):
            begin, n_units = colours[body, colour], colours[body, colour + 1] - colours[body, colour]
            if n_units > 0:
                lo, hi = share(n_units, crew.thread, crew.n_threads)
                for unit in range(begin + lo, begin + hi):
                    stiffen_unit(run, A, p, run.units[unit, 0], run.units[unit, 1], crew.thread)
                barrier(run.arrivals, crew.n_threads)


@kernel
def stiffen_unit(run: NodeRun, A: Array, p: Array, lo: int, hi: int, thread: int) -> None:
    """Add the change of the forces of the particles lo .. hi."""
    setting, stencils, tiles = run.setting, run.stencils, run.tiles
    dims, factor, width = setting.dims, 4.0 / setting.dx, LANE_BYTES // run.fields.itemsize
    value, moment = tiles.value[thread], tiles.moment[thread]
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather(p, stencils, value, moment, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            Q = scale(get_columns(moment, TILE, i - tile, dims), -factor * factor)
            put_linear(value, moment, stencils, i, i - tile, times(A, i, Q), dims)
        scatter_tile(run.force, (value,), (moment,), stencils, tile, end, setting.strides, dims)


find_tangent_each = for_each(find_tangent)


@allocating_kernel
def add_blocks(run: NodeRun, A: Array, blocks: Array, lo: int, hi: int) -> None:
    """Add to the diagonal blocks (M, D, D) of the stiffness matrix those of the particles lo .. hi; on one thread."""
    setting, dim, width = run.setting, len(run.setting.dims), A.shape[2]
    ways = 3 if dim == 3 else 1
    w, d = np.zeros((3, 3)), np.zeros(3)
    for p in range(lo, hi):
        for axis in range(3):
            f = run.stencils.f[p, axis]
            w[axis, 0], w[axis, 1], w[axis, 2] = 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2
        for a in range(ways):
            for b in range(3):
                for c in range(3):
                    n = node_of(run.stencils, run.stencils.first[p], a, b, c, setting.strides)
                    weight = (w[0, a] if dim == 3 else 1.0) * w[1, b] * w[2, c] * 4.0 / setting.dx
                    d[0], d[1], d[2] = a - run.stencils.f[p, 0], b - run.stencils.f[p, 1], c - run.stencils.f[p, 2]
                    for i in range(dim):
                        for k in range(i + 1):
                            total = 0.0
                            for j in range(dim):
                                for m in range(dim):
                                    row, column = i * dim + j, k * dim + m
                                    if row < column:
                                        row, column = column, row
                                    entry = A[p // width, row * (row + 1) // 2 + column, p % width]
                                    total += entry * d[j + 3 - dim] * d[m + 3 - dim]
                            blocks[n, i, k] += weight * weight * total
