"""Forces on points of the bodies, such as cables, and their adjoints (`forces/force.py` has the forces themselves).

A point moves with the nodes of its stencil, x = X + sum_n w u_n, and gives each of them its weight's share of its
force. Threads share points, then items, then nodes, and each node sums its shares in a fixed order.
"""

from __future__ import annotations

from cqrun.engine.arrays import first_row_of_v
from cqrun.engine.exert import add_level_bars_of_each, exert_of_each, exert_of_each_vjp
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep, PointLoads, Points
from cqrun.engine.reference.shape import place_pulls
from cqrun.engine.setting import Crew, Drive
from cqrun.forces.force import Levels
from cqrun.forces.pulled import Pulled
from cqrun.numerics.compile import barrier, for_each, kernel, share
from cqrun.plugin.contract import Array
from cqrun.state import X


@kernel
def place_points(load: PointLoads, run: NodeRun, u: Array, stride: int, v: Array, crew: Crew) -> None:
    """Write positions and velocities of all points into their table; node n has row n * stride of u, and row n of v."""
    points, q, rest, dim = load.points, load.q, load.rest, len(run.setting.dims)
    width, V = q.shape[2], first_row_of_v(run.setting.dims)
    lo, hi = share(len(rest), crew.thread, crew.n_threads)
    for j in range(lo, hi):
        for d in range(dim):
            x, speed = rest[j, d], 0.0
            for k in range(points.node.shape[1]):
                x += points.weight[j, k] * u[points.node[j, k] * stride, d]
                speed += points.weight[j, k] * v[points.node[j, k], d]
            q[j // width, X + d, j % width] = x
            q[j // width, V + d, j % width] = speed
    barrier(run.arrivals, crew.n_threads)


@kernel
def pull(load: PointLoads, drive: Drive, run: NodeRun, at: NodeStep, crew: Crew) -> None:
    """Add all forces on points to `run.force`."""
    pulled = load.pulled
    place_points(load, run, at.u, 1, at.v, crew)
    exert_of_each(drive.forces, drive.levels, at.control, load.q, crew)
    barrier(run.arrivals, crew.n_threads)
    share_out(load.points, pulled, pulled.shares.force, run.force, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)


@kernel
def share_out(points: Points, pulled: Pulled, force: Array, out: Array, stride: int, first: int, crew: Crew) -> None:
    """Add the points' numbers (S, D) to the nodes: node n has row n * stride + first of `out`."""
    lo, hi = share(len(points.nodes), crew.thread, crew.n_threads)
    for k in range(lo, hi):
        n = points.nodes[k] * stride + first
        for index in range(points.begin[k], points.begin[k + 1]):
            j = points.point[index]
            for s in range(pulled.begin[j], pulled.begin[j + 1]):
                for d in range(force.shape[1]):
                    out[n, d] += points.share[index] * force[pulled.order[s], d]


@kernel
def spread_to_points(load: PointLoads, values: Array, stride: int, first: int, crew: Crew) -> None:
    """Write sum_n w value_n of all points to load.push; node n has row n * stride + first."""
    points, push = load.points, load.push
    width = push.shape[2]
    lo, hi = share(len(load.rest), crew.thread, crew.n_threads)
    for j in range(lo, hi):
        for d in range(push.shape[1]):
            total = 0.0
            for k in range(points.node.shape[1]):
                total += points.weight[j, k] * values[stride * points.node[j, k] + first, d]
            push[j // width, d, j % width] = total


@kernel
def pull_vjp(
    load: PointLoads, drive: Drive, levels_bar: Levels, run: NodeRun, bars: NodeBars, at: NodeStep, crew: Crew
) -> None:
    """Run the adjoint at bars.pairs: add to bars.sums as `press_unit_vjp` does, and to the cotangents of levels."""
    points, pulled = load.points, load.pulled
    place_points(load, run, bars.pairs, 2, at.v, crew)
    spread_to_points(load, bars.pairs, 2, 1, crew)
    barrier(run.arrivals, crew.n_threads)
    exert_of_each(drive.forces, drive.levels, at.control, load.q, crew)
    exert_of_each_vjp(drive.forces, drive.levels, at.control, load.q, load.push, crew)
    barrier(run.arrivals, crew.n_threads)
    shares = pulled.shares
    place_pulls(bars.shape, points, pulled, run, bars.pairs, at, crew)
    share_out(points, pulled, shares.x_bar, bars.sums, 2, 0, crew)
    if run.setting.rates:
        share_out(points, pulled, shares.v_bar, bars.sums, 2, 1, crew)
    else:
        share_out(points, pulled, shares.force, bars.sums, 2, 1, crew)
    if crew.thread == 0:
        add_level_bars_of_each(drive.forces, levels_bar, at.control)
    barrier(run.arrivals, crew.n_threads)


place_points_each = for_each(place_points)
pull_each = for_each(pull)
pull_each_vjp = for_each(pull_vjp)
