"""Averaged volumes: bodies that keep their volume bend as softly as they should, where each particle's own would lock.

With local volumes every particle resists a change of its own volume, more conditions than the nodes can meet as nu
nears 1/2. Here the part U(J) of the energy (materials/volume.py) acts on means over the cells' corners. With the hat
functions N of the corners, which lie between the nodes at half cells, the energy is

    sum_c V_c U(J_c),   J_c = sum_p N_cp vol0_p J_p / V_c,   V_c = sum_p N_cp vol0_p,

with parameters that are means in the same way. So a particle's stress has the pressure p_p = sum_c N_cp U'(J_c):

    tau = (that of all terms) + (p_p - U'(J_p)) J_p I.

It is a potential of the positions: forces conserve energy, and their tangent is symmetric. J - 1 is averaged in place
of J, which loses no digits. A corner has the number of the node below it, and a particle those of its stencil's first
two nodes along each axis. Means of this kind are known from nodal integration (Dohrmann et al. 2000, Int. J. Numer.
Meth. Eng. 47).

Adjoint, with tau_bar of the stress and the pressure's cotangent pbar_c = sum_p N_cp J_p tr(tau_bar_p):

    b_c = U''(J_c) pbar_c / V_c,   J_bar_p = tr(tau_bar) (p_p - U' - U'' J) + vol0_p sum_c N_cp b_c,
    vol0_bar_p = sum_c N_cp b_c (J_p - J_c).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from cqrun.engine.arrays import get_columns, load_F, load_matrix, store_F, store_matrix
from cqrun.engine.reference.setting import TILE, NodeRun
from cqrun.engine.setting import Crew
from cqrun.engine.stencils import Stencils, node_of
from cqrun.engine.transfer import gather, gather_both
from cqrun.materials.volume import total_curvature, total_slope, total_slope_vjp
from cqrun.numerics.compile import barrier, for_each, for_one, kernel, own_symbols, share
from cqrun.numerics.lanes import LANE_BYTES
from cqrun.numerics.packed import accumulate, load, store
from cqrun.numerics.tensor import add, cofactor, det, inner, plus_diagonal, scale, trace
from cqrun.plugin.contract import Array
from cqrun.state import VOLUME


class Numbers(NamedTuple):
    """Numbers in a row, and the same memory as lanes."""

    each: Array  # (m,)
    lanes: Array  # (m / width, 1, width)


class Means(NamedTuple):
    """The corners of one group's bodies, and its terms whose energy has a part of the volume alone."""

    begin: int  # the group's first node
    local: tuple[Any, ...]  # the terms with the parameters of the particles
    terms: tuple[Any, ...]  # the same with the means at the corners
    inverse: Numbers  # (m,) 1 / V, or 0 where no particle is
    pressure: Numbers  # (m,) the sum of N vol0 (J - 1), and then U'
    at: Numbers  # (threads, TILE) of the particles of a tile


class MeansBars(NamedTuple):
    """Cotangents of `Means`, and what its adjoint works with."""

    local: tuple[Any, ...]
    terms: tuple[Any, ...]
    ratio: Numbers  # (m,) pbar, and then b
    product: Numbers  # (m,) b (J - 1)
    slopes: Array  # (D^2, n) the gradient Q of the force's cotangent, packed
    at: Numbers  # (threads, TILE)
    at_2: Numbers


own_symbols(Numbers)
own_symbols(Means)
own_symbols(MeansBars)


# --- between particles and corners ------------------------------------------------------------------------------------


@kernel
def spread(corners: Array, begin: int, number: Array, stencils: Stencils, lo: int, hi: int, run: NodeRun) -> None:
    """Add the numbers of the particles lo .. hi to their corners, with the hats as weights."""
    strides, ways = run.setting.strides, len(run.setting.dims) - 1
    for p in range(lo, hi):
        first = stencils.first[p]
        x, y, z = stencils.f[p, 0] - 0.5, stencils.f[p, 1] - 0.5, stencils.f[p, 2] - 0.5
        for i in range(ways):
            of_x = number[p - lo] * (abs(1.0 - i - x) if ways == 2 else 1.0)
            for j in range(2):
                of_y = of_x * abs(1.0 - j - y)
                corners[node_of(stencils, first, i, j, 0, strides) - begin] += of_y * (1.0 - z)
                corners[node_of(stencils, first, i, j, 1, strides) - begin] += of_y * z


@kernel
def collect(corners: Array, begin: int, number: Array, stencils: Stencils, lo: int, hi: int, run: NodeRun) -> None:
    """Write the sum over a particle's corners of N times their number, for the particles lo .. hi."""
    strides, ways = run.setting.strides, len(run.setting.dims) - 1
    for p in range(lo, hi):
        first, total = stencils.first[p], 0.0
        x, y, z = stencils.f[p, 0] - 0.5, stencils.f[p, 1] - 0.5, stencils.f[p, 2] - 0.5
        for i in range(ways):
            of_x = abs(1.0 - i - x) if ways == 2 else 1.0
            for j in range(2):
                low = corners[node_of(stencils, first, i, j, 0, strides) - begin]
                high = corners[node_of(stencils, first, i, j, 1, strides) - begin]
                total += of_x * abs(1.0 - j - y) * ((1.0 - z) * low + z * high)
        number[p - lo] = total


# --- the means --------------------------------------------------------------------------------------------------------


@kernel
def average(means: Means, run: NodeRun, u: Array, first: int, last: int, colours: Array, crew: Crew) -> None:
    """Write U' at the corners of the bodies first .. last for a displacement u, and the particles' F to `run.q`."""
    clear(means.pressure.each, crew)
    barrier(run.arrivals, crew.n_threads)
    for body in range(first, last):
        for colour in range(8):
            begin, n_units = colours[body, colour], colours[body, colour + 1] - colours[body, colour]
            if n_units > 0:
                lo, hi = share(n_units, crew.thread, crew.n_threads)
                for unit in range(begin + lo, begin + hi):
                    average_unit(means, run, u, run.units[unit, 0], run.units[unit, 1], crew.thread)
                barrier(run.arrivals, crew.n_threads)
    width = LANE_BYTES // run.fields.itemsize
    lo, hi = share(means.pressure.lanes.shape[0], crew.thread, crew.n_threads)
    for i in range(lo * width, hi * width, width):
        J = load(means.pressure.lanes, 0, i) * load(means.inverse.lanes, 0, i) + 1.0
        store(means.pressure.lanes, 0, i, total_slope(means.terms, i, J))
    barrier(run.arrivals, crew.n_threads)


@kernel
def average_unit(means: Means, run: NodeRun, u: Array, lo: int, hi: int, thread: int) -> None:
    """Add vol0 (J - 1) of the particles lo .. hi to their corners."""
    setting, tiles, width = run.setting, run.tiles, LANE_BYTES // run.fields.itemsize
    value, moment, dims, factor = tiles.value[thread], tiles.moment[thread], setting.dims, 4.0 / setting.dx
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather(u, run.stencils, value, moment, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            F = plus_diagonal(scale(get_columns(moment, TILE, i - tile, dims), factor), 1.0)
            store_F(run.q, i, F, dims)
            store(means.at.lanes[thread], 0, i - tile, load(run.fields, VOLUME, i) * (det(F) - 1.0))
        spread(means.pressure.each, means.begin, means.at.each[thread], run.stencils, tile, end, run)


@kernel
def average_both(
    pair: tuple[Means, MeansBars], run: NodeRun, pairs: Array, first: int, last: int, colours: Array, crew: Crew
) -> None:
    """Do what `average` does, and write b at the corners.

    Args:
        pairs: at each node the displacement and the cotangent of its force.
    """
    means, bars = pair
    clear(means.pressure.each, crew)
    clear(bars.ratio.each, crew)
    barrier(run.arrivals, crew.n_threads)
    for body in range(first, last):
        for colour in range(8):
            begin, n_units = colours[body, colour], colours[body, colour + 1] - colours[body, colour]
            if n_units > 0:
                lo, hi = share(n_units, crew.thread, crew.n_threads)
                for unit in range(begin + lo, begin + hi):
                    average_both_unit(means, bars, run, pairs, run.units[unit, 0], run.units[unit, 1], crew.thread)
                barrier(run.arrivals, crew.n_threads)
    width = LANE_BYTES // run.fields.itemsize
    lo, hi = share(means.pressure.lanes.shape[0], crew.thread, crew.n_threads)
    for i in range(lo * width, hi * width, width):
        inverse = load(means.inverse.lanes, 0, i)
        J = load(means.pressure.lanes, 0, i) * inverse + 1.0
        b = total_slope_vjp(means.terms, bars.terms, i, J, load(bars.ratio.lanes, 0, i)) * inverse
        store(means.pressure.lanes, 0, i, total_slope(means.terms, i, J))
        store(bars.ratio.lanes, 0, i, b)
        store(bars.product.lanes, 0, i, b * (J - 1.0))
    barrier(run.arrivals, crew.n_threads)


@kernel
def average_both_unit(means: Means, bars: MeansBars, run: NodeRun, pairs: Array, lo: int, hi: int, thread: int) -> None:
    """Add vol0 (J - 1) and the cotangent of the pressure of the particles lo .. hi to their corners; keep F and Q."""
    setting, tiles, width = run.setting, run.tiles, LANE_BYTES // run.fields.itemsize
    moment, moment_2, dims, factor = tiles.moment[thread], tiles.moment_2[thread], setting.dims, 4.0 / setting.dx
    for tile in range(lo, hi, TILE):
        end = min(tile + TILE, hi)
        gather_both(pairs, run.stencils, moment, moment_2, tile, end, setting.strides, dims)
        for i in range(tile, end, width):
            F = plus_diagonal(scale(get_columns(moment, TILE, i - tile, dims), factor), 1.0)
            Q = scale(get_columns(moment_2, TILE, i - tile, dims), factor)
            store_F(run.q, i, F, dims)
            store_matrix(bars.slopes, i, Q, dims)
            vol = load(run.fields, VOLUME, i)
            store(means.at.lanes[thread], 0, i - tile, vol * (det(F) - 1.0))
            # J tr(tau_bar) with tau_bar = -vol0 Q F^-1
            store(bars.at.lanes[thread], 0, i - tile, inner(Q, cofactor(F)) * (vol * -1.0))
        spread(means.pressure.each, means.begin, means.at.each[thread], run.stencils, tile, end, run)
        spread(bars.ratio.each, means.begin, bars.at.each[thread], run.stencils, tile, end, run)


@kernel
def clear(numbers: Array, crew: Crew) -> None:
    """Set one thread's share of the numbers to zero."""
    lo, hi = share(len(numbers), crew.thread, crew.n_threads)
    for i in range(lo, hi):
        numbers[i] = 0.0


# --- in the sweep over particles --------------------------------------------------------------------------------------


@kernel
def collect_pressure(means: Means, run: NodeRun, tile: int, end: int, thread: int) -> None:
    """Write the mean pressures of a tile to `means.at`."""
    collect(means.pressure.each, means.begin, means.at.each[thread], run.stencils, tile, end, run)


@kernel
def collect_all(pair: tuple[Means, MeansBars], run: NodeRun, tile: int, end: int, thread: int) -> None:
    """Write the mean pressures, b and b (J - 1) of a tile."""
    means, bars = pair
    collect_pressure(means, run, tile, end, thread)
    collect(bars.ratio.each, means.begin, bars.at.each[thread], run.stencils, tile, end, run)
    collect(bars.product.each, means.begin, bars.at_2.each[thread], run.stencils, tile, end, run)


@kernel
def kept_F(means: Means, moment: Array, q: Array, i: int, at: int, dims: Any, factor: float) -> Any:
    """Return F as `average` has kept it."""
    return load_F(q, i, dims)


@kernel
def gathered_F(moment: Array, q: Array, i: int, at: int, dims: Any, factor: float) -> Any:
    """Return F from the moment of the displacement."""
    return plus_diagonal(scale(get_columns(moment, TILE, at, dims), factor), 1.0)


@kernel
def kept_Q(pair: tuple[Means, MeansBars], moment: Array, i: int, at: int, dims: Any, factor: float) -> Any:
    """Return Q as `average_both` has kept it."""
    return load_matrix(pair[1].slopes, i, dims)


@kernel
def gathered_Q(moment: Array, i: int, at: int, dims: Any, factor: float) -> Any:
    """Return Q from the moment of the force's cotangent."""
    return scale(get_columns(moment, TILE, at, dims), factor)


@kernel
def add_mean(means: Means, tau: Any, F: Any, i: int, at: int, thread: int) -> Any:
    """Return a stress with the mean pressure in place of the particle's own."""
    J = det(F)
    return plus_diagonal(tau, (load(means.at.lanes[thread], 0, at) - total_slope(means.local, i, J)) * J)


@kernel
def unchanged(tau: Any, F: Any, i: int, at: int, thread: int) -> Any:
    """Return the stress."""
    return tau


@kernel
def add_mean_slope(means: Means, F_bar: Any, F: Any, tau_bar: Any, i: int, at: int, thread: int) -> Any:
    """Return the cotangent of F with that of `add_mean` at a constant mean pressure."""
    J, own = det(F), means.local
    more = load(means.at.lanes[thread], 0, at) - total_slope(own, i, J) - total_curvature(own, i, J) * J
    return add(F_bar, scale(cofactor(F), trace(tau_bar) * more))


@kernel
def unchanged_slope(F_bar: Any, F: Any, tau_bar: Any, i: int, at: int, thread: int) -> Any:
    """Return the cotangent of F."""
    return F_bar


@kernel
def add_mean_both(
    pair: tuple[Means, MeansBars], tau: Any, F_bar: Any, F: Any, tau_bar: Any, vol: Any, fields_bar: Array, i: int,
    at: int, thread: int,
) -> Any:  # fmt: skip
    """Return the stress of `add_mean`, and the cotangent of F with that through the volume."""
    means, bars = pair
    J, tr = det(F), trace(tau_bar)
    more = load(means.at.lanes[thread], 0, at) - total_slope(means.local, i, J)
    b = load(bars.at.lanes[thread], 0, at)
    J_bar = tr * more + total_slope_vjp(means.local, bars.local, i, J, tr * J * -1.0) + vol * b
    accumulate(fields_bar, VOLUME, i, b * (J - 1.0) - load(bars.at_2.lanes[thread], 0, at))
    return plus_diagonal(tau, more * J), add(F_bar, scale(cofactor(F), J_bar))


@kernel
def unchanged_both(
    tau: Any, F_bar: Any, F: Any, tau_bar: Any, vol: Any, fields_bar: Array, i: int, at: int, thread: int
) -> Any:
    """Return the stress and the cotangent of F."""
    return tau, F_bar


average_each, average_both_each = for_each(average), for_each(average_both)
collect_pressures, collect_bars = for_each(collect_pressure), for_each(collect_all)
find_F, find_Q = for_one(kept_F, gathered_F), for_one(kept_Q, gathered_Q)
with_mean, with_mean_slope = for_one(add_mean, unchanged), for_one(add_mean_slope, unchanged_slope)
with_mean_both = for_one(add_mean_both, unchanged_both)
