"""Contact between bodies in a substep, and its adjoint: points of each surface against the facets of the others.

A point that is inside another body is pushed to the nearest point of the facets near it, whose vertices get the
opposite force by their weights. Both surfaces have points, so each has the half of a penalty; the moduli of two
materials act like springs in series. Momentum is exact: the weights sum to 1.

Points compute their own contacts, then each sums what acts on it as a vertex, then each node sums its points, all in a
fixed order. A point is in one other body at most; of several the one whose facet is nearest counts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.boundaries.solid import ZERO
from cqrun.engine.reference.facet import SAME, above, mean_of, nearest_on, nearest_vjp, row
from cqrun.engine.reference.meeting import Meeting
from cqrun.engine.reference.movers import add_weight_bars, load_spring, place, places, put, share_out, store_spring
from cqrun.engine.reference.neighbours import watch_pairs
from cqrun.engine.reference.rub import meet, meet_vjp
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import barrier, for_each, kernel, share
from cqrun.numerics.tensor import add, dot, scale, sub
from cqrun.plugin.contract import Array

FAR = 1e300


@kernel
def facet_around(meeting: Meeting, s: int) -> Any:
    """Return the facet of another body in which a point is, and the weights of its nearest point; or -1.

    Of the facets of one body the nearest decides, and of those equally near the one farthest from whose plane the
    point is, because at an edge only that one knows the sides. Facets farther than half the margin do not count.
    """
    facets, pairs, x = meeting.facets, meeting.pairs, row(meeting.x, s)
    best, best_weights, best_square = -1, ZERO, FAR
    for first in range(pairs.many[s]):
        body, seen = facets.body[facets.corner[pairs.facets[s, first], 0]], False
        for before in range(first):
            seen = seen or facets.body[facets.corner[pairs.facets[s, before], 0]] == body
        if seen:
            continue
        near, near_weights, near_square, near_height = -1, ZERO, FAR, 0.0
        for index in range(first, pairs.many[s]):
            f = pairs.facets[s, index]
            if facets.body[facets.corner[f, 0]] != body:
                continue
            weights, square = nearest_on(facets.corner, f, x, meeting.x)
            if square > near_square * (1.0 + SAME):
                continue
            height = above(facets.corner, f, x, meeting.x)
            if square < near_square * (1.0 - SAME) or abs(height) > abs(near_height):
                near, near_weights, near_square, near_height = f, weights, square, height
        if near >= 0 and near_height < 0.0 and near_square < min(best_square, 0.25 * pairs.margin**2):
            best, best_weights, best_square = near, near_weights, near_square
    return best, best_weights


@kernel
def moduli(meeting: Meeting, s: int, f: int) -> Any:
    """Return K [N/m] and C [N s/m] of a point in a facet: those of two springs, and two dashpots, in series."""
    facets = meeting.facets
    k, other, area = facets.stiffness[s], facets.facet_stiffness[f], facets.area[s]
    z, z_other = facets.impedance[s], facets.facet_impedance[f]
    return area * k * other / (k + other), meeting.dashpot * area * z * z_other / (z + z_other)


@kernel
def offset(meeting: Meeting, s: int, f: int, weights: Any) -> Any:
    """Return g from the nearest point of a facet, the depth h = |g|, the normal -g / h and the relative velocity."""
    corner = meeting.facets.corner
    g = sub(row(meeting.x, s), mean_of(corner, f, weights, meeting.x))
    h = np.sqrt(dot(g, g))
    n = scale(g, -1.0 / h) if h > 0.0 else ZERO
    return g, h, n, sub(row(meeting.v, s), mean_of(corner, f, weights, meeting.v))


@kernel
def move_points(meeting: Meeting, u: Array, v: Array, crew: Crew) -> None:
    """Find positions and velocities of all active points, for displacements u and velocities v of the nodes."""
    pairs, surface = meeting.pairs, meeting.surface
    lo, hi = share(pairs.count[1], crew.thread, crew.n_threads)
    for index in range(lo, hi):
        s = pairs.active[index]
        x, speed = places(surface.points, surface.rest, s, u, v)
        put(meeting.x, s, x)
        put(meeting.v, s, speed)


@kernel
def encounter(meeting: Meeting, run: NodeRun, at: NodeStep, u_next: Array, keep: bool, crew: Crew) -> None:
    """Add the forces between bodies to `run.force`, and write the springs after the substep."""
    pairs, springs, begin = meeting.pairs, meeting.springs > 0, len(run.nodes.mass)
    changed = watch_pairs(meeting, run, at.u, crew)
    if (keep or changed) and springs:
        lo, hi = share(len(pairs.flag), crew.thread, crew.n_threads)
        for s in range(lo, hi):
            if pairs.many[s] == 0:
                store_spring(u_next, at.v_next, begin, meeting.first + s, ZERO)
    if pairs.count[0] == 0:
        return
    move_points(meeting, at.u, at.v, crew)
    barrier(run.arrivals, crew.n_threads)
    lo, hi = share(pairs.count[0], crew.thread, crew.n_threads)
    for index in range(lo, hi):
        s, spring = pairs.points[index], ZERO
        if springs:
            spring = load_spring(at.u, at.v, begin, meeting.first + s)
        after, slid = press_in(meeting, s, spring, run.setting.dt)
        if springs:
            store_spring(u_next, at.v_next, begin, meeting.first + s, after)
        if slid:
            meeting.slid[crew.thread] = 1
    barrier(run.arrivals, crew.n_threads)
    sum_forces(meeting, crew)
    barrier(run.arrivals, crew.n_threads)
    share_out(meeting.pairs.movers, meeting.force, run.force, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)


@kernel
def press_in(meeting: Meeting, s: int, spring: Any, dt: float) -> Any:
    """Find the facet around a point and the force from it; return the spring, and whether more than places matters."""
    f, weights = facet_around(meeting, s)
    meeting.touched[s] = f
    if f < 0:
        return ZERO, False
    put(meeting.weights, s, weights)
    K, C = moduli(meeting, s, f)
    _, h, n, v = offset(meeting, s, f, weights)
    force, after = meet(K, C, meeting.surface.onset, meeting.friction, dt, h, n, v, spring)
    put(meeting.push, s, force)
    return after, C > 0.0 or meeting.springs > 0


@kernel
def sum_forces(meeting: Meeting, crew: Crew) -> None:
    """Sum the forces on each active point: that of the facet in which it is, and its share of those on its facets."""
    pairs, corner = meeting.pairs, meeting.facets.corner
    lo, hi = share(pairs.count[1], crew.thread, crew.n_threads)
    if lo == hi:
        return
    first, last = pairs.active[lo], pairs.active[hi - 1]
    for index in range(lo, hi):
        put(meeting.force, pairs.active[index], ZERO)
    for index in range(pairs.count[0]):
        s = pairs.points[index]
        f = meeting.touched[s]
        if f < 0:
            continue
        push = row(meeting.push, s)
        if first <= s <= last:
            put(meeting.force, s, add(row(meeting.force, s), push))
        for v in range(corner.shape[1]):
            t = corner[f, v]
            if first <= t <= last:
                put(meeting.force, t, sub(row(meeting.force, t), scale(push, meeting.weights[s, v])))


@kernel
def press_in_vjp(meeting: Meeting, s: int, spring: Any, dt: float, after_bar: Any) -> Any:
    """Write the cotangents of a point's contact; return that of the spring before."""
    f, corner = meeting.touched[s], meeting.facets.corner
    weights = row(meeting.weights, s)
    K, C = moduli(meeting, s, f)
    g, h, n, v = offset(meeting, s, f, weights)
    force_bar = sub(row(meeting.p, s), mean_of(corner, f, weights, meeting.p))
    mu_bar, h_bar, n_bar, v_bar, spring_bar = meet_vjp(
        K, C, meeting.surface.onset, meeting.friction, dt, h, n, v, spring, force_bar, after_bar
    )
    if meeting.springs > 0:
        meeting.friction_bar[s] += mu_bar
    # h = |g| and n = -g / h
    g_bar = sub(scale(sub(n_bar, scale(n, dot(n, n_bar))), -1.0 / h), scale(n, h_bar)) if h > 0.0 else ZERO
    x_bar, a_bar, b_bar, c_bar = nearest_vjp(
        corner, f, weights, meeting.x, g, weights_bar_of(meeting, s, f, v_bar), g_bar
    )
    put(meeting.x_bars[s], 0, x_bar)
    put(meeting.x_bars[s], 1, a_bar)
    put(meeting.x_bars[s], 2, b_bar)
    put(meeting.x_bars[s], 3, c_bar)
    put(meeting.v_bar, s, v_bar)
    return spring_bar


@kernel
def weights_bar_of(meeting: Meeting, s: int, f: int, v_bar: Any) -> Any:
    """Return the cotangents of the weights, by which forces go to vertices and the facet's velocity is found."""
    corner, push = meeting.facets.corner, row(meeting.push, s)
    a, b, c = corner[f, 0], corner[f, 1], corner[f, corner.shape[1] - 1]
    return (
        -dot(push, row(meeting.p, a)) - dot(v_bar, row(meeting.v, a)),
        -dot(push, row(meeting.p, b)) - dot(v_bar, row(meeting.v, b)),
        -dot(push, row(meeting.p, c)) - dot(v_bar, row(meeting.v, c)),
    )


@kernel
def sum_cotangents(meeting: Meeting, crew: Crew) -> None:
    """Sum the cotangents of each active point, as `sum_forces` does."""
    pairs, corner = meeting.pairs, meeting.facets.corner
    lo, hi = share(pairs.count[1], crew.thread, crew.n_threads)
    if lo == hi:
        return
    first, last = pairs.active[lo], pairs.active[hi - 1]
    for index in range(lo, hi):
        put(meeting.u_sum, pairs.active[index], ZERO)
        put(meeting.v_sum, pairs.active[index], ZERO)
    for index in range(pairs.count[0]):
        s = pairs.points[index]
        f = meeting.touched[s]
        if f < 0:
            continue
        v_bar = row(meeting.v_bar, s)
        if first <= s <= last:
            put(meeting.u_sum, s, add(row(meeting.u_sum, s), row(meeting.x_bars[s], 0)))
            put(meeting.v_sum, s, add(row(meeting.v_sum, s), v_bar))
        for v in range(corner.shape[1]):
            t = corner[f, v]
            if first <= t <= last:
                put(meeting.u_sum, t, add(row(meeting.u_sum, t), row(meeting.x_bars[s], 1 + v)))
                put(meeting.v_sum, t, sub(row(meeting.v_sum, t), scale(v_bar, meeting.weights[s, v])))


@kernel
def encounter_vjp(meeting: Meeting, run: NodeRun, bars: NodeBars, at: NodeStep, reversed_: bool, crew: Crew) -> None:
    """Run the adjoint at bars.pairs; see `touch_vjp`."""
    pairs, springs, begin = meeting.pairs, meeting.springs > 0, len(run.nodes.mass)
    if watch_pairs(meeting, run, at.u, crew) and springs:
        lo, hi = share(len(pairs.flag), crew.thread, crew.n_threads)
        for s in range(lo, hi):
            if pairs.many[s] == 0:
                store_spring(bars.u, bars.v, begin, meeting.first + s, ZERO)
    if pairs.count[0] == 0:
        return
    move_points(meeting, at.u, at.v, crew)
    lo, hi = share(pairs.count[1], crew.thread, crew.n_threads)
    for index in range(lo, hi):
        s = pairs.active[index]
        put(meeting.p, s, place(meeting.surface.points, s, bars.pairs, 2, 1))
    barrier(run.arrivals, crew.n_threads)
    lo, hi = share(pairs.count[0], crew.thread, crew.n_threads)
    for index in range(lo, hi):
        s, spring, after_bar, spring_bar = pairs.points[index], ZERO, ZERO, ZERO
        if springs:
            spring = load_spring(at.u, at.v, begin, meeting.first + s)
            after_bar = load_spring(bars.u, bars.v, begin, meeting.first + s)
        press_in(meeting, s, spring, run.setting.dt)
        if meeting.touched[s] >= 0:
            spring_bar = press_in_vjp(meeting, s, spring, run.setting.dt, after_bar)
        if springs:
            store_spring(bars.u, bars.v, begin, meeting.first + s, spring_bar)
    barrier(run.arrivals, crew.n_threads)
    sum_cotangents(meeting, crew)
    shaped = len(meeting.bars.rest) > 0
    if reversed_ or shaped:
        sum_forces(meeting, crew)
    if shaped:  # of the active points that are this thread's, as in both sums
        lo, hi = share(pairs.count[1], crew.thread, crew.n_threads)
        for index in range(lo, hi):
            s = pairs.active[index]
            add_weight_bars(
                meeting.surface.points, meeting.bars, s, at, bars.pairs, row(meeting.u_sum, s), row(meeting.v_sum, s),
                row(meeting.force, s),
            )  # fmt: skip
    barrier(run.arrivals, crew.n_threads)
    share_out(meeting.pairs.movers, meeting.u_sum, bars.sums, 2, 0, crew)
    if reversed_:
        share_out(meeting.pairs.movers, meeting.force, bars.sums, 2, 1, crew)
    barrier(run.arrivals, crew.n_threads)


@kernel
def encounter_rates_vjp(meeting: Meeting, run: NodeRun, bars: NodeBars, crew: Crew) -> None:
    """Add the cotangents of velocities, which `encounter_vjp` has found."""
    share_out(meeting.pairs.movers, meeting.v_sum, bars.v, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)


encounter_each = for_each(encounter)
encounter_each_vjp = for_each(encounter_vjp)
encounter_rates_each_vjp = for_each(encounter_rates_vjp)
