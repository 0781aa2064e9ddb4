"""What is seen of the particles at the end of a control step, x, v, C and F, from the motion of the nodes; adjoint.

x = X + sum_n w u_n,  v = sum_n w v_n,  F = I + A sum_n w u_n d^T,  C = F' F^-1,  F' = A sum_n w v_n d^T
"""

from __future__ import annotations

from cqrun.engine.arrays import (
    get_columns,
    get_vector,
    load_C,
    load_F,
    load_v,
    load_vector,
    load_x,
    store_C,
    store_F,
    store_v,
    store_x,
)
from cqrun.engine.reference.fields import put_affine
from cqrun.engine.reference.setting import TILE, NodeBars, NodeRun
from cqrun.engine.reference.shape import place_looks
from cqrun.engine.setting import Crew
from cqrun.engine.transfer import gather, scatter_tile
from cqrun.numerics.compile import barrier, kernel, share
from cqrun.numerics.lanes import LANE_BYTES
from cqrun.numerics.tensor import add, cofactor, det, mul, mul_at, mul_bt, plus_diagonal, scale, sub
from cqrun.plugin.contract import Array


@kernel
def look(run: NodeRun, u: Array, v: Array, crew: Crew) -> None:
    """Write the state of all particles to `run.q`."""
    lo, hi = share(len(run.units), crew.thread, crew.n_threads)
    for unit in range(lo, hi):
        look_unit(run, u, v, run.units[unit, 0], run.units[unit, 1], crew.thread)
    barrier(run.arrivals, crew.n_threads)


@kernel
def look_unit(run: NodeRun, u: Array, v: Array, lo: int, hi: int, thread: int) -> None:
    """Write the state of the particles lo .. hi."""
    setting, stencils, tiles, q = run.setting, run.stencils, run.tiles, run.q
    dims, factor, width = setting.dims, 4.0 / setting.dx, LANE_BYTES // run.q.itemsize
    value, moment, value_2, moment_2 = (
        tiles.value[thread], tiles.moment[thread], tiles.value_2[thread], tiles.moment_2[thread],
    )  # fmt: skip
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather(u, stencils, value, moment, tile, end, setting.strides, dims)
        gather(v, stencils, value_2, moment_2, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            F = plus_diagonal(scale(get_columns(moment, TILE, i - tile, dims), factor), 1.0)
            rate = scale(get_columns(moment_2, TILE, i - tile, dims), factor)
            store_x(q, i, add(load_vector(run.rest, 0, i, dims), get_vector(value, i - tile, dims)), dims)
            store_v(q, i, get_vector(value_2, i - tile, dims), dims)
            store_F(q, i, F, dims)
            store_C(q, i, mul_bt(rate, scale(cofactor(F), 1.0 / det(F))), dims)


@kernel
def look_vjp(run: NodeRun, bars: NodeBars, pairs_bar: Array, colours: Array, u: Array, v: Array, crew: Crew) -> None:
    """Add the adjoint of `look` at bars.q to the cotangents of u and v, which follow each other in `pairs_bar`."""
    for body in range(colours.shape[0]):
        for colour in range(8):
            begin, n_units = colours[body, colour], colours[body, colour + 1] - colours[body, colour]
            if n_units > 0:
                lo, hi = share(n_units, crew.thread, crew.n_threads)
                for unit in range(begin + lo, begin + hi):
                    look_unit_vjp(run, bars, pairs_bar, u, v, run.units[unit, 0], run.units[unit, 1], crew.thread)
                barrier(run.arrivals, crew.n_threads)


@kernel
def look_unit_vjp(
    run: NodeRun, bars: NodeBars, pairs_bar: Array, u: Array, v: Array, lo: int, hi: int, thread: int
) -> None:
    """Run the adjoint of `look_unit`."""
    setting, stencils, tiles, q_bar = run.setting, run.stencils, run.tiles, bars.q
    dims, factor, width = setting.dims, 4.0 / setting.dx, LANE_BYTES // run.q.itemsize
    value, moment, value_2, moment_2 = (
        tiles.value[thread], tiles.moment[thread], tiles.value_2[thread], tiles.moment_2[thread],
    )  # fmt: skip
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather(u, stencils, value, moment, tile, end, setting.strides, dims)
        gather(v, stencils, value_2, moment_2, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            F = plus_diagonal(scale(get_columns(moment, TILE, i - tile, dims), factor), 1.0)
            rate = scale(get_columns(moment_2, TILE, i - tile, dims), factor)
            Gt = scale(cofactor(F), 1.0 / det(F))
            rate_bar = mul(load_C(q_bar, i, dims), Gt)
            F_bar = sub(load_F(q_bar, i, dims), mul_at(mul_bt(rate, Gt), rate_bar))
            put_affine(value, moment, stencils, i, i - tile, scale(F_bar, factor), load_x(q_bar, i, dims), dims)
            put_affine(value_2, moment_2, stencils, i, i - tile, scale(rate_bar, factor), load_v(q_bar, i, dims), dims)
        place_looks(bars.shape, run, q_bar, u, v, tile, end, thread)
        scatter_tile(pairs_bar, (value, value_2), (moment, moment_2), stencils, tile, end, setting.strides, dims)
