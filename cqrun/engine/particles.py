"""Passes over particles, lane by lane: momentum before P2G, motion after G2P, and their adjoints.

A particle's momentum for the next substep needs nothing but its own motion in this one. So `move` can go on with
it tile by tile, while the tile is in the cache (`ahead`); so can `momentum_vjp` with the adjoint of the substep before.

Momentum (CQ1 eqs 3-5), with kappa = exp(-damping dt), all external forces f, and tau the Kirchhoff stress:

    p = kappa m v + dt f,    G = kappa m C - (4 / dx^2) dt vol0 tau(F, C)
    mv_n = sum_p w (p + G d),  d = x_n - x_p

Motion (CQ1 eqs 8-10), with B = sum_n w v_n d^T:

    v' = sum_n w v_n,  C' = (4 / dx^2) B,  F' = (I + dt C') F,  x' = x + dt v'

In cells, d = dx (o - f): P2G scatters a = p, columns dx G; G2P gathers B / dx.
"""

from __future__ import annotations

from cqrun.engine.arrays import (
    add_vector,
    fraction,
    get_columns,
    get_extra,
    get_place,
    get_vector,
    greatest_square,
    load_matrix,
    load_vector,
    put_columns,
    put_place,
    put_vector,
    store_matrix,
    store_vector,
    within,
)
from cqrun.engine.setting import MARGIN, TILE, Group, Setting, Work
from cqrun.engine.transfer import gather, gather_vjp
from cqrun.materials.term import total_kirchhoff, total_kirchhoff_vjp
from cqrun.numerics.compile import kernel, one_body, share
from cqrun.numerics.lanes import LANE_BYTES, all_lanes, lane, select
from cqrun.numerics.packed import accumulate, load
from cqrun.numerics.tensor import add, dot, inner, matvec, matvec_t, mul, mul_at, mul_bt, scale, shift, sub
from cqrun.plugin.contract import Array
from cqrun.state import DECAY, FORCE, MASS, PADDING, VOLUME


@kernel
def tiles_of(group: Group, thread: int, n_threads: int) -> tuple[int, int]:
    """Return the columns of a body that fall to one thread, whole lanes of any precision."""
    lo, hi = share((group.hi - group.lo) // PADDING, thread, n_threads)
    return group.lo + lo * PADDING, group.lo + hi * PADDING


@kernel
def momentum(
    group: Group, q: Array, fields: Array, push: Array, setting: Setting, work: Work, thread: int, n_threads: int
) -> None:
    """Write what P2G scatters for one body's particles; `push` is the force of actuators, if there are any."""
    lo, hi = tiles_of(group, thread, n_threads)
    write_momentum(group, q, fields, push, setting, work, lo, hi)


@one_body
def write_momentum(
    group: Group, q: Array, fields: Array, push: Array, setting: Setting, work: Work, lo: int, hi: int
) -> None:
    """Write what P2G scatters for columns lo .. hi of a body."""
    dims, dx, dt = setting.dims, setting.dx, setting.dt
    D, n = len(dims), work.place.shape[0]
    width = LANE_BYTES // q.itemsize
    pushed = push.shape[0] > 0
    for i in range(lo, hi, width):
        C = load_matrix(q, 2 * D, i, dims)
        F = load_matrix(q, 2 * D + D * D, i, dims)
        m, kept = load(fields, MASS, i), load(fields, MASS, i) * load(fields, DECAY, i)
        tau = total_kirchhoff(group.terms, i, F, C)
        f = load_vector(fields, FORCE, i, dims)
        if pushed:
            f = add(f, load_vector(push, 0, i, dims))
        p = add(scale(load_vector(q, D, i, dims), kept), scale(f, dt))
        pull = load(fields, VOLUME, i) * (-4.0 * dt / dx)
        A = add(scale(C, kept * dx), scale(tau, pull))
        X = shift(scale(load_vector(q, 0, i, dims), 1.0 / dx), MARGIN)
        put_vector(work.value, i, sub(p, matvec(A, fraction(X))), m, dims)
        put_columns(work.affine, n, i, A, dims)
        put_place(work.place, i, X, dims)


@kernel
def move(
    group: Group, q: Array, q_next: Array, fields: Array, push: Array, ahead: bool, setting: Setting, work: Work,
    thread: int, n_threads: int,
) -> None:  # fmt: skip
    """Gather the grid velocity and move one body's particles; q_next may be q.

    Leaves the greatest |v|^2 and the first stray particle in the thread's slots of `work`.

    Args:
        fields, push, ahead: whether to go on with the momentum of the next substep, and what that needs.
    """
    dims, dx, dt = setting.dims, setting.dx, setting.dt
    D = len(dims)
    width = LANE_BYTES // q.itemsize
    lo, hi = tiles_of(group, thread, n_threads)
    value, moment = work.tile_value[thread], work.tile_moment[thread]
    fastest = load(q, 0, group.lo) * 0.0
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather(work.grid, work.place, value, moment, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            v = get_vector(value, i - tile, dims)
            C = scale(get_columns(moment, TILE, i - tile, dims), 4.0 / dx)
            F = load_matrix(q, 2 * D + D * D, i, dims)
            x = add(load_vector(q, 0, i, dims), scale(v, dt))
            store_vector(q_next, 0, i, x, dims)
            store_vector(q_next, D, i, v, dims)
            store_matrix(q_next, 2 * D, i, C, dims)
            store_matrix(q_next, 2 * D + D * D, i, add(F, scale(mul(C, F), dt)), dims)
            fastest = greatest_square(fastest, v)
            inside = within(shift(scale(x, 1.0 / dx), MARGIN), setting.upper)
            if not all_lanes(inside) and work.stray[thread] < 0:
                work.stray[thread] = i
        if ahead:
            write_momentum(group, q_next, fields, push, setting, work, tile, end)
    for k in range(width):
        work.speed[thread] = max(work.speed[thread], lane(fastest, k))


@kernel
def move_vjp(
    group: Group, q: Array, q_next: Array, q_bar: Array, setting: Setting, work: Work, thread: int, n_threads: int
) -> None:
    """Write what the adjoint of G2P scatters, and begin the cotangent of q in place of that of q_next."""
    lo, hi = tiles_of(group, thread, n_threads)
    begin_cotangent(group, q, q_next, q_bar, setting, work, lo, hi, thread)


@one_body
def begin_cotangent(
    group: Group, q: Array, q_next: Array, q_bar: Array, setting: Setting, work: Work, lo: int, hi: int, thread: int
) -> None:
    """Do `move_vjp` for columns lo .. hi of a body."""
    dims, dx, dt = setting.dims, setting.dx, setting.dt
    D, n = len(dims), work.place.shape[0]
    width = LANE_BYTES // q.itemsize
    fastest = load(q, 0, group.lo) * 0.0
    for i in range(lo, hi, width):
        v, C = load_vector(q_next, D, i, dims), load_matrix(q_next, 2 * D, i, dims)
        F = load_matrix(q, 2 * D + D * D, i, dims)
        x_bar, F_bar = load_vector(q_bar, 0, i, dims), load_matrix(q_bar, 2 * D + D * D, i, dims)
        v_bar = add(load_vector(q_bar, D, i, dims), scale(x_bar, dt))
        C_bar = add(load_matrix(q_bar, 2 * D, i, dims), scale(mul_bt(F_bar, F), dt))
        A = scale(C_bar, 4.0 / dx)
        X = shift(scale(load_vector(q, 0, i, dims), 1.0 / dx), MARGIN)
        put_vector(work.value_2, i, sub(v_bar, matvec(A, fraction(X))), 0.0, dims)
        put_columns(work.affine_2, n, i, A, dims)
        # the arm d = x_n - x_p of G2P's moments
        store_vector(q_bar, 0, i, sub(x_bar, scale(matvec_t(A, v), 1.0 / dx)), dims)
        store_matrix(q_bar, 2 * D + D * D, i, add(F_bar, scale(mul_at(C, F_bar), dt)), dims)
        fastest = greatest_square(fastest, v)
    for k in range(width):
        work.speed[thread] = max(work.speed[thread], lane(fastest, k))


@kernel
def momentum_vjp(
    groups: tuple[Group, Group], q: Array, q_bar: Array, fields: Array, fields_bar: Array, push_bar: Array,
    ahead: bool, q_before: Array, push: Array, setting: Setting, work: Work, thread: int, n_threads: int,
) -> None:  # fmt: skip
    """Gather the adjoints of both transfers, finish the cotangent of q, add to those of all parameters.

    Args:
        groups: a body and its cotangent.
        push_bar: becomes the cotangent of this substep's push.
        ahead, q_before, push: whether to go on with the adjoint of the substep before this, the state that it began
            from, and what pushes in it.
    """
    group, group_bar = groups
    dims, dx, dt = setting.dims, setting.dx, setting.dt
    D, n = len(dims), work.place.shape[0]
    width = LANE_BYTES // q.itemsize
    lo, hi = tiles_of(group, thread, n_threads)
    value, moment, slope = work.tile_value[thread], work.tile_moment[thread], work.tile_slope[thread]
    fields_1, fields_2 = (work.value, work.affine), (work.value_2, work.affine_2)
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather_vjp(
            work.both, fields_1, fields_2, work.place, value, moment, slope, tile, end, setting.strides, dims
        )  # fmt: skip
        for i in range(tile, end, width):
            v, C = load_vector(q, D, i, dims), load_matrix(q, 2 * D, i, dims)
            F, A = load_matrix(q, 2 * D + D * D, i, dims), get_columns(work.affine, n, i, dims)
            m, kappa = load(fields, MASS, i), load(fields, DECAY, i)
            p_bar = get_vector(value, i - tile, dims)
            G_bar = scale(get_columns(moment, TILE, i - tile, dims), dx)
            # position: through the weights, and through the arm d of P2G's field
            X_bar = sub(get_place(slope, i - tile, dims), matvec_t(A, p_bar))
            add_vector(q_bar, 0, i, scale(X_bar, 1.0 / dx), dims)
            kept_bar = dot(p_bar, v) + inner(G_bar, C)
            accumulate(fields_bar, MASS, i, get_extra(value, i - tile, dims) + kappa * kept_bar)
            accumulate(fields_bar, DECAY, i, m * kept_bar)
            add_vector(fields_bar, FORCE, i, scale(p_bar, dt), dims)
            if push_bar.shape[0] > 0:
                store_vector(push_bar, 0, i, scale(p_bar, dt), dims)
            # G is linear in vol0: (G - kappa m C) / vol0 is its derivative
            vol = load(fields, VOLUME, i)
            stressed = inner(sub(scale(A, 1.0 / dx), scale(C, m * kappa)), G_bar)
            present = vol > 0.0
            accumulate(fields_bar, VOLUME, i, select(present, stressed / select(present, vol, 1.0), 0.0))
            tau_bar = scale(G_bar, vol * (-4.0 * dt / (dx * dx)))
            F_bar, C_bar = total_kirchhoff_vjp(group.terms, group_bar.terms, i, F, C, tau_bar)
            store_vector(q_bar, D, i, scale(p_bar, m * kappa), dims)
            store_matrix(q_bar, 2 * D, i, add(C_bar, scale(G_bar, m * kappa)), dims)
            F_bar = add(F_bar, load_matrix(q_bar, 2 * D + D * D, i, dims))
            store_matrix(q_bar, 2 * D + D * D, i, F_bar, dims)
        if ahead:
            begin_cotangent(group, q_before, q, q_bar, setting, work, tile, end, thread)
            write_momentum(group, q_before, fields, push, setting, work, tile, end)
