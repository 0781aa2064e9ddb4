"""Forces on points of the bodies, such as cables, and their adjoints (`forces/force.py` has the forces themselves).

A point moves with the nodes of its stencil, x = X + sum_n w u_n, and gives each of them its weight's share of its
force. Threads share points, then items, then nodes, and each node sums its shares in a fixed order.
"""

from __future__ import annotations

from cqrun.engine.arrays import first_row_of_v
from cqrun.engine.exert import add_level_bars_of_each, exert_of_each, exert_of_each_vjp
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep, Points
from cqrun.engine.reference.shape import place_pulls
from cqrun.engine.setting import Crew, Drive
from cqrun.forces.force import Levels
from cqrun.forces.pulled import Pulled
from cqrun.numerics.compile import barrier, for_each, kernel, share
from cqrun.plugin.contract import Array
from cqrun.state import X


@kernel
def place_points(points: Points, run: NodeRun, u: Array, stride: int, v: Array, crew: Crew) -> None:
    """Write positions and velocities of all points into `run.q`; node n has row n * stride of u, and row n of v."""
    q, rest, dim = run.q, run.rest, len(run.setting.dims)
    width, V = q.shape[2], first_row_of_v(run.setting.dims)
    lo, hi = share(len(points.columns), crew.thread, crew.n_threads)
    for j in range(lo, hi):
        p = points.columns[j]
        for d in range(dim):
            x, speed = rest[p // width, d, p % width], 0.0
            for k in range(points.node.shape[1]):
                x += points.weight[j, k] * u[points.node[j, k] * stride, d]
                speed += points.weight[j, k] * v[points.node[j, k], d]
            q[p // width, X + d, p % width] = x
            q[p // width, V + d, p % width] = speed
    barrier(run.arrivals, crew.n_threads)


@kernel
def pull(pair: tuple[Points, Pulled], drive: Drive, run: NodeRun, at: NodeStep, crew: Crew) -> None:
    """Add all forces on points to `run.force`."""
    points, pulled = pair
    place_points(points, run, at.u, 1, at.v, crew)
    exert_of_each(drive.forces, drive.levels, at.control, run.q, crew)
    barrier(run.arrivals, crew.n_threads)
    share_out(points, pulled, pulled.shares.force, run.force, 1, 0, crew)
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
def pull_vjp(
    pair: tuple[Points, Pulled], drive: Drive, levels_bar: Levels, run: NodeRun, bars: NodeBars, at: NodeStep,
    crew: Crew,
) -> None:  # fmt: skip
    """Run the adjoint at bars.pairs: add to bars.sums as `press_unit_vjp` does, and to the cotangents of levels."""
    points, pulled = pair
    place_points(points, run, bars.pairs, 2, at.v, crew)
    lo, hi = share(len(points.columns), crew.thread, crew.n_threads)
    width = bars.push.shape[2]
    for j in range(lo, hi):
        p = points.columns[j]
        for d in range(bars.push.shape[1]):
            total = 0.0
            for k in range(points.node.shape[1]):
                total += points.weight[j, k] * bars.pairs[2 * points.node[j, k] + 1, d]
            bars.push[p // width, d, p % width] = total
    barrier(run.arrivals, crew.n_threads)
    exert_of_each(drive.forces, drive.levels, at.control, run.q, crew)
    exert_of_each_vjp(drive.forces, drive.levels, at.control, run.q, bars.push, crew)
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


pull_each = for_each(pull)
pull_each_vjp = for_each(pull_vjp)
