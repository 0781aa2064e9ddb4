"""The sweep over particles of a substep, and its adjoint: internal forces from displacements.

With weights w and arms d = X_n - X_p of the rest positions, and A = 4 / dx^2 (design: total Lagrangian MLS-MPM)

    F_p = I + A sum_n w u_n d^T,    f_n = -sum_p w A vol0 P d,    P = tau F^-T

and for stresses that depend on rates L = F' F^-1 with F' = A sum_n w v_n d^T. In cells d = dx (o - f), so the moments
of `transfer.gather` are those of F - I times dx / 4, and each particle scatters the affine field -(4 / dx) vol0 P.

Adjoint: with the cotangent p_n of the forces, Q = A sum_n w p_n d^T and G = F^-1, the work is -vol0 P : Q, so

    tau_bar = -vol0 Q G,   F_bar = (those of tau) + vol0 G^T Q^T tau G^T,   u_bar_n += A sum_p w F_bar d.
"""

from __future__ import annotations

from typing import Any

from cqrun.engine.arrays import get_columns
from cqrun.engine.reference.fields import put_linear
from cqrun.engine.reference.setting import TILE, NodeBars, NodeRun
from cqrun.engine.reference.shape import keep_force, place_stress
from cqrun.engine.reference.volume import (
    average_both_each,
    average_each,
    collect_bars,
    collect_pressures,
    find_F,
    find_Q,
    with_mean,
    with_mean_both,
)
from cqrun.engine.setting import Crew, Group
from cqrun.engine.transfer import gather, gather_both, scatter_tile
from cqrun.materials.stress import total_kirchhoff, total_kirchhoff_both
from cqrun.materials.term import zeros_like_rows
from cqrun.numerics.compile import barrier, for_each, kernel, share
from cqrun.numerics.lanes import LANE_BYTES
from cqrun.numerics.packed import accumulate, load
from cqrun.numerics.tensor import add, cofactor, det, inner, mul, mul_at, mul_bt, scale, sub
from cqrun.plugin.contract import Array
from cqrun.state import VOLUME


@kernel
def press(part: tuple[Group, Any, int, int], run: NodeRun, u: Array, v: Array, colours: Array, crew: Crew) -> None:
    """Add the internal forces of a group's particles to `run.force`, for displacements u and velocities v.

    Histories in `run.q` become those after the substep.

    Args:
        part: a group, the means of its volumes or none, its first body, and the body after its last.
        colours: (B, 9) where the units of each body and colour begin.
    """
    group, means, first, last = part
    average_each(means, run, u, first, last, colours, crew)
    for body in range(first, last):
        for colour in range(8):
            begin, n_units = colours[body, colour], colours[body, colour + 1] - colours[body, colour]
            if n_units > 0:
                lo, hi = share(n_units, crew.thread, crew.n_threads)
                for unit in range(begin + lo, begin + hi):
                    press_unit(group, means, run, u, v, run.units[unit, 0], run.units[unit, 1], crew.thread)
                barrier(run.arrivals, crew.n_threads)


@kernel
def press_unit(group: Group, means: Any, run: NodeRun, u: Array, v: Array, lo: int, hi: int, thread: int) -> None:
    """Add the internal forces of the particles lo .. hi."""
    setting, stencils, tiles, fields = run.setting, run.stencils, run.tiles, run.fields
    dims, factor, width = setting.dims, 4.0 / setting.dx, LANE_BYTES // run.fields.itemsize
    value, moment, moment_2 = tiles.value[thread], tiles.moment[thread], tiles.moment_2[thread]
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        if len(means) == 0:
            gather(u, stencils, value, moment, tile, end, setting.strides, dims)
        collect_pressures(means, run, tile, end, thread)
        if setting.rates:
            gather(v, stencils, value, moment_2, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            F = find_F(means, moment, run.q, i, i - tile, dims, factor)
            Gt = scale(cofactor(F), 1.0 / det(F))
            C = zeros_like_rows(F)
            if setting.rates:
                C = mul_bt(scale(get_columns(moment_2, TILE, i - tile, dims), factor), Gt)
            tau = total_kirchhoff(group.terms, run.q, run.q, i, F, C, setting.dt)
            tau = with_mean(means, tau, F, i, i - tile, thread)
            A = scale(mul(tau, Gt), load(fields, VOLUME, i) * -factor)
            put_linear(value, moment, stencils, i, i - tile, A, dims)
        scatter_tile(run.force, (value,), (moment,), stencils, tile, end, setting.strides, dims)


@kernel
def press_vjp(
    part: tuple[tuple[Group, Group], Any, int, int], run: NodeRun, bars: NodeBars, v: Array, colours: Array, crew: Crew
) -> None:
    """Run the adjoint of `press` at bars.pairs: add to bars.sums and to the cotangents of the particles.

    Histories in `run.q` are those before the substep; their cotangents in `bars.q`, after it, become those before it.

    `part` has the group and the means of its volumes, if there are any, each with its cotangent.
    """
    groups, means, first, last = part
    average_both_each(means, run, bars.pairs, first, last, colours, crew)
    for body in range(first, last):
        for colour in range(8):
            begin, n_units = colours[body, colour], colours[body, colour + 1] - colours[body, colour]
            if n_units > 0:
                lo, hi = share(n_units, crew.thread, crew.n_threads)
                for unit in range(begin + lo, begin + hi):
                    press_unit_vjp(groups, means, run, bars, v, run.units[unit, 0], run.units[unit, 1], crew.thread)
                barrier(run.arrivals, crew.n_threads)


@kernel
def press_unit_vjp(
    groups: tuple[Group, Group], means: Any, run: NodeRun, bars: NodeBars, v: Array, lo: int, hi: int, thread: int
) -> None:
    """Run the adjoint for the particles lo .. hi.

    The second field that is scattered is the force, from which a reversed run finds the velocity before the substep.
    With rates, a run is not reversed, and the second field is the cotangent of the velocity.
    """
    group, group_bar = groups
    setting, stencils, tiles, fields = run.setting, run.stencils, run.tiles, run.fields
    dims, factor, width = setting.dims, 4.0 / setting.dx, LANE_BYTES // run.fields.itemsize
    value, moment, value_2 = tiles.value[thread], tiles.moment[thread], tiles.value_2[thread]
    moment_2, moment_3 = tiles.moment_2[thread], tiles.moment_3[thread]
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        if len(means) == 0:
            gather_both(bars.pairs, stencils, moment, moment_2, tile, end, setting.strides, dims)
        collect_bars(means, run, tile, end, thread)
        if setting.rates:
            gather(v, stencils, value, moment_3, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            F = find_F(means, moment, run.q, i, i - tile, dims, factor)
            Q = find_Q(means, moment_2, i, i - tile, dims, factor)
            Gt = scale(cofactor(F), 1.0 / det(F))
            C = zeros_like_rows(F)
            if setting.rates:
                C = mul_bt(scale(get_columns(moment_3, TILE, i - tile, dims), factor), Gt)
            vol, H = load(fields, VOLUME, i), mul_bt(Q, Gt)  # H = Q F^-1
            tau_bar = scale(H, vol * -1.0)
            tau, F_bar, C_bar = total_kirchhoff_both(
                group.terms, group_bar.terms, run.q, bars.q, i, F, C, setting.dt, tau_bar
            )
            tau, F_bar = with_mean_both(means, tau, F_bar, F, tau_bar, vol, bars.fields, i, i - tile, thread)
            accumulate(bars.fields, VOLUME, i, inner(tau, H) * -1.0)
            P = mul(tau, Gt)
            F_bar = add(F_bar, scale(mul(Gt, mul_at(Q, P)), vol))
            keep_force(bars.shape, run, scale(P, vol * -factor), i, i - tile, thread)
            if setting.rates:
                rate_bar = mul(C_bar, Gt)
                F_bar = sub(F_bar, mul_at(C, rate_bar))
                put_linear(value_2, moment_2, stencils, i, i - tile, scale(rate_bar, factor), dims)
            else:
                put_linear(value_2, moment_2, stencils, i, i - tile, scale(P, vol * -factor), dims)
            put_linear(value, moment, stencils, i, i - tile, scale(F_bar, factor), dims)
        place_stress(bars.shape, means, run, bars.pairs, v, tile, end, thread)
        scatter_tile(bars.sums, (value, value_2), (moment, moment_2), stencils, tile, end, setting.strides, dims)


press_each = for_each(press)
press_each_vjp = for_each(press_vjp)
