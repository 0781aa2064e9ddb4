"""Passes over particles, lane by lane: momentum before P2G, motion after G2P, and their adjoints.

A particle's momentum for the next substep depends only on its own motion in this one. So `move` can also compute it,
tile by tile, while the tile is in the cache (`Substep.ahead`), and `momentum_vjp` can start the adjoint of the previous
substep. Only lanes that forces pull must wait for all particles (`forces.py`).

Momentum (CQ1 eqs 3-5), with kappa = exp(-damping dt), the external forces f and the Kirchhoff stress tau:

    p = kappa m v + dt f,    G = kappa m C - (4 / dx^2) dt vol0 tau(F, C)
    mv_n = sum_p w (p + G d),  d = x_n - x_p

Motion (CQ1 eqs 8-10), with B = sum_n w v_n d^T:

    v' = sum_n w v_n,  C' = (4 / dx^2) B,  F' = (I + dt C') F,  x' = x + dt v'.

The momentum's pass also gives the histories of material terms after the substep. In cells d = dx (o - f), so P2G
scatters p and dx G, and G2P gathers B / dx.
"""

from __future__ import annotations

from typing import Any

from numba.extending import overload

from cqrun.engine.arrays import (
    add_vector,
    add_x,
    fraction,
    get_columns,
    get_extra,
    get_place,
    get_vector,
    greatest_square,
    load_C,
    load_F,
    load_v,
    load_vector,
    load_x,
    put_columns,
    put_place,
    put_vector,
    store_C,
    store_F,
    store_v,
    store_vector,
    store_x,
    within,
)
from cqrun.engine.setting import MARGIN, Crew, Group
from cqrun.engine.transfer import gather, gather_vjp
from cqrun.engine.updated.setting import TILE, Bars, Run, Substep
from cqrun.materials.stress import total_kirchhoff, total_kirchhoff_vjp
from cqrun.numerics.compile import for_each, kernel, one_body, share
from cqrun.numerics.lanes import LANE_BYTES, all_lanes, lane, select
from cqrun.numerics.packed import accumulate, load
from cqrun.numerics.tensor import add, dot, inner, matvec, matvec_t, mul, mul_at, mul_bt, scale, shift, sub
from cqrun.plugin.contract import Array
from cqrun.state import DECAY, FORCE, MASS, PADDING, VOLUME


@kernel
def tiles_of(group: Group, crew: Crew) -> tuple[int, int]:
    """Return one thread's columns of a group: whole lanes for any precision."""
    lo, hi = share((group.hi - group.lo) // PADDING, crew.thread, crew.n_threads)
    return group.lo + lo * PADDING, group.lo + hi * PADDING


@kernel
def momentum(group: Group, run: Run, at: Substep, crew: Crew) -> None:
    """Write the fields that P2G scatters for the particles of a group, but for lanes that forces pull."""
    if not at.begun:
        lo, hi = tiles_of(group, crew)
        write_but_for(group.pulled, group, run, at.q, at.q_next, lo, hi)


@one_body
def write_momentum(group: Group, run: Run, q: Array, q_next: Array, lo: int, hi: int) -> None:
    """Write the fields that P2G scatters for columns lo .. hi of a group, and their next histories to q_next.

    q_next may be q, so this runs once for each column in a substep.
    """
    setting, work, fields, push = run.setting, run.work, run.fields, run.push
    dims, dx, dt = setting.dims, setting.dx, setting.dt
    n, width, pushed = work.place.shape[0], LANE_BYTES // q.itemsize, push.shape[0] > 0
    for i in range(lo, hi, width):
        C, F = load_C(q, i, dims), load_F(q, i, dims)
        m, kept = load(fields, MASS, i), load(fields, MASS, i) * load(fields, DECAY, i)
        tau = total_kirchhoff(group.terms, q, q_next, i, F, C, dt)
        f = load_vector(fields, FORCE, i, dims)
        if pushed:
            f = add(f, load_vector(push, 0, i, dims))
        p = add(scale(load_v(q, i, dims), kept), scale(f, dt))
        pull = load(fields, VOLUME, i) * (-4.0 * dt / dx)
        A = add(scale(C, kept * dx), scale(tau, pull))
        X = shift(scale(load_x(q, i, dims), 1.0 / dx), MARGIN)
        put_vector(work.value, i, sub(p, matvec(A, fraction(X))), m, dims)
        put_columns(work.affine, n, i, A, dims)
        put_place(work.place, i, X, dims)


@kernel
def write_between_lanes(lanes: Array, group: Group, run: Run, q: Array, q_next: Array, lo: int, hi: int) -> None:
    """Write the momentum of columns lo .. hi without the lanes that forces pull."""
    begin = lo
    for lane_at in lanes[first_at_least(lanes, lo) : first_at_least(lanes, hi)]:
        if lane_at > begin:
            write_momentum(group, run, q, q_next, begin, lane_at)
        begin = lane_at + LANE_BYTES // q.itemsize
    if hi > begin:
        write_momentum(group, run, q, q_next, begin, hi)


def write_but_for(pulled: Any, group: Any, run: Run, q: Array, q_next: Array, lo: int, hi: int) -> None:
    """Write the momentum of columns lo .. hi without the lanes in `pulled`, if there is any."""
    if pulled:
        write_between_lanes(pulled[0].first, group, run, q, q_next, lo, hi)
    else:
        write_momentum(group, run, q, q_next, lo, hi)


@overload(write_but_for)
def _write_but_for(pulled, group, run, q, q_next, lo, hi):
    def some(pulled, group, run, q, q_next, lo, hi):
        write_between_lanes(pulled[0].first, group, run, q, q_next, lo, hi)

    def none(pulled, group, run, q, q_next, lo, hi):
        write_momentum(group, run, q, q_next, lo, hi)

    return some if len(pulled) else none


@kernel
def move(group: Group, run: Run, at: Substep, crew: Crew) -> None:
    """Gather the grid velocity and move a group's particles; if `ahead`, write the momentum of the next substep.

    Write the largest |v|^2 and the first stray particle into the thread's entries of `work`.
    """
    setting, work, q, q_next, thread = run.setting, run.work, at.q, at.q_next, crew.thread
    dims, dx, dt = setting.dims, setting.dx, setting.dt
    width = LANE_BYTES // q.itemsize
    lo, hi = tiles_of(group, crew)
    value, moment = work.tile_value[thread], work.tile_moment[thread]
    fastest = load(q, 0, group.lo) * 0.0
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather(work.grid, work.place, value, moment, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            v = get_vector(value, i - tile, dims)
            C = scale(get_columns(moment, TILE, i - tile, dims), 4.0 / dx)
            F = load_F(q, i, dims)
            x = add(load_x(q, i, dims), scale(v, dt))
            F_next = add(F, scale(mul(C, F), dt))
            store_x(q_next, i, x, dims)
            store_v(q_next, i, v, dims)
            store_C(q_next, i, C, dims)
            store_F(q_next, i, F_next, dims)
            fastest = greatest_square(fastest, v)
            inside = within(shift(scale(x, 1.0 / dx), MARGIN), setting.upper)
            if not all_lanes(inside) and work.stray[thread] < 0:
                work.stray[thread] = i
        if at.ahead:
            write_but_for(group.pulled, group, run, q_next, at.q_after, tile, end)
    for k in range(width):
        work.speed[thread] = max(work.speed[thread], lane(fastest, k))


@kernel
def move_vjp(groups: tuple[Group, Group], run: Run, bars: Bars, at: Substep, crew: Crew) -> None:
    """Write the fields that the adjoint of G2P scatters, and turn the cotangent of q_next into a part of that of q."""
    if not at.begun:
        lo, hi = tiles_of(groups[0], crew)
        begin_cotangent(groups[0], run, at.q, at.q_next, bars.q, lo, hi, crew.thread)


@one_body
def begin_cotangent(
    group: Group, run: Run, q: Array, q_next: Array, q_bar: Array, lo: int, hi: int, thread: int
) -> None:
    """Run `move_vjp` for columns lo .. hi of a group."""
    setting, work = run.setting, run.work
    dims, dx, dt = setting.dims, setting.dx, setting.dt
    n, width = work.place.shape[0], LANE_BYTES // q.itemsize
    fastest = load(q, 0, group.lo) * 0.0
    for i in range(lo, hi, width):
        v, C = load_v(q_next, i, dims), load_C(q_next, i, dims)
        F = load_F(q, i, dims)
        x_bar, F_bar = load_x(q_bar, i, dims), load_F(q_bar, i, dims)
        v_bar = add(load_v(q_bar, i, dims), scale(x_bar, dt))
        C_bar = add(load_C(q_bar, i, dims), scale(mul_bt(F_bar, F), dt))
        A = scale(C_bar, 4.0 / dx)
        X = shift(scale(load_x(q, i, dims), 1.0 / dx), MARGIN)
        put_vector(work.value_2, i, sub(v_bar, matvec(A, fraction(X))), 0.0, dims)
        put_columns(work.affine_2, n, i, A, dims)
        # the arm d = x_n - x_p of G2P's moments
        store_x(q_bar, i, sub(x_bar, scale(matvec_t(A, v), 1.0 / dx)), dims)
        store_F(q_bar, i, add(F_bar, scale(mul_at(C, F_bar), dt)), dims)
        fastest = greatest_square(fastest, v)
    for k in range(width):
        work.speed[thread] = max(work.speed[thread], lane(fastest, k))


@kernel
def momentum_vjp(groups: tuple[Group, Group], run: Run, bars: Bars, at: Substep, crew: Crew) -> None:
    """Gather the adjoints of both transfers, finish the cotangent of q, and add to those of all parameters.

    Write the cotangent of the forces to `bars.push`. If `ahead`, start the adjoint of the previous substep in the lanes
    that forces do not pull.
    """
    group, group_bar = groups
    setting, work, q, q_bar, fields, fields_bar = run.setting, run.work, at.q, bars.q, run.fields, bars.fields
    push_bar, steady_bar = bars.push, bars.steady_push
    dims, dx, dt = setting.dims, setting.dx, setting.dt
    n, width, thread = work.place.shape[0], LANE_BYTES // q.itemsize, crew.thread
    lo, hi = tiles_of(group, crew)
    value, moment, slope = work.tile_value[thread], work.tile_moment[thread], work.tile_slope[thread]
    fields_1, fields_2 = (work.value, work.affine), (work.value_2, work.affine_2)
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather_vjp(work.both, fields_1, fields_2, work.place, value, moment, slope, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            v, C = load_v(q, i, dims), load_C(q, i, dims)
            F, A = load_F(q, i, dims), get_columns(work.affine, n, i, dims)
            m, kappa = load(fields, MASS, i), load(fields, DECAY, i)
            p_bar = get_vector(value, i - tile, dims)
            G_bar = scale(get_columns(moment, TILE, i - tile, dims), dx)
            # position: through the weights, and through the arm d of P2G's field
            X_bar = sub(get_place(slope, i - tile, dims), matvec_t(A, p_bar))
            add_x(q_bar, i, scale(X_bar, 1.0 / dx), dims)
            kept_bar = dot(p_bar, v) + inner(G_bar, C)
            accumulate(fields_bar, MASS, i, get_extra(value, i - tile, dims) + kappa * kept_bar)
            accumulate(fields_bar, DECAY, i, m * kept_bar)
            add_vector(fields_bar, FORCE, i, scale(p_bar, dt), dims)
            if push_bar.shape[0] > 0:
                store_vector(push_bar, 0, i, scale(p_bar, dt), dims)
            if steady_bar.shape[0] > 0:
                add_vector(steady_bar, 0, i, scale(p_bar, dt), dims)
            # G is linear in vol0: (G - kappa m C) / vol0 is its derivative
            vol = load(fields, VOLUME, i)
            stressed = inner(sub(scale(A, 1.0 / dx), scale(C, m * kappa)), G_bar)
            present = vol > 0.0
            accumulate(fields_bar, VOLUME, i, select(present, stressed / select(present, vol, 1.0), 0.0))
            tau_bar = scale(G_bar, vol * (-4.0 * dt / (dx * dx)))
            F_bar, C_bar = total_kirchhoff_vjp(group.terms, group_bar.terms, q, q_bar, i, F, C, dt, tau_bar)
            store_v(q_bar, i, scale(p_bar, m * kappa), dims)
            store_C(q_bar, i, add(C_bar, scale(G_bar, m * kappa)), dims)
            store_F(q_bar, i, add(F_bar, load_F(q_bar, i, dims)), dims)
        if at.ahead:
            begin_but_for(group.pulled, group, run, bars, at, tile, end, thread)
            write_but_for(group.pulled, group, run, at.q_before, q, tile, end)


@kernel
def begin_between_lanes(
    lanes: Array, group: Group, run: Run, bars: Bars, at: Substep, lo: int, hi: int, thread: int
) -> None:
    """Start the adjoint of the previous substep in columns lo .. hi without the lanes that forces pull."""
    begin = lo
    for lane_at in lanes[first_at_least(lanes, lo) : first_at_least(lanes, hi)]:
        if lane_at > begin:
            begin_cotangent(group, run, at.q_before, at.q, bars.q, begin, lane_at, thread)
        begin = lane_at + LANE_BYTES // at.q.itemsize
    if hi > begin:
        begin_cotangent(group, run, at.q_before, at.q, bars.q, begin, hi, thread)


def begin_but_for(pulled: Any, group: Any, run: Run, bars: Bars, at: Substep, lo: int, hi: int, thread: int) -> None:
    """Start the adjoint of the previous substep in columns lo .. hi without the lanes in `pulled`, if there is any."""
    if pulled:
        begin_between_lanes(pulled[0].first, group, run, bars, at, lo, hi, thread)
    else:
        begin_cotangent(group, run, at.q_before, at.q, bars.q, lo, hi, thread)


@overload(begin_but_for)
def _begin_but_for(pulled, group, run, bars, at, lo, hi, thread):
    def some(pulled, group, run, bars, at, lo, hi, thread):
        begin_between_lanes(pulled[0].first, group, run, bars, at, lo, hi, thread)

    def none(pulled, group, run, bars, at, lo, hi, thread):
        begin_cotangent(group, run, at.q_before, at.q, bars.q, lo, hi, thread)

    return some if len(pulled) else none


@kernel
def first_at_least(increasing: Array, value: int) -> int:
    """Return the index of the first entry that is not less than a value."""
    lo, hi = 0, len(increasing)
    while lo < hi:
        middle = (lo + hi) // 2
        lo, hi = (middle + 1, hi) if increasing[middle] < value else (lo, middle)
    return lo


momentum_of_each = for_each(momentum)
move_each = for_each(move)
move_each_vjp = for_each(move_vjp)
momentum_of_each_vjp = for_each(momentum_vjp)
