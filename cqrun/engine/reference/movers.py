"""Points of a surface and the nodes that move them: positions from nodes, and forces to nodes in a fixed order."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.reference.setting import NodeStep, Points
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import kernel, own_symbols, share
from cqrun.plugin.contract import Array


class Movers(NamedTuple):
    """The nodes that move one of some points, and for each of them its points, in increasing order.

    The lists are as long as those of all points; only their beginnings are filled.
    """

    node: Array  # (K,) the first count[0] nodes
    begin: Array  # (K + 1,) where the points of a node begin
    point: Array
    share: Array
    count: Array  # (1,)


class SurfaceBars(NamedTuple):
    """Cotangents of points at rest: positions (S, 3) and weights (S, 3^D); without rows if they are not wanted."""

    rest: Array
    weight: Array


own_symbols(Movers)
own_symbols(SurfaceBars)


def zero_bars(points: Points, wanted: bool) -> SurfaceBars:
    """Return zero cotangents."""
    n = len(points.node) if wanted else 0
    return SurfaceBars(np.zeros((n, 3)), np.zeros((n, points.node.shape[1])))


def make_movers(points: Points) -> Movers:
    """Return empty lists for some of these points."""
    k, n = len(points.nodes), len(points.point)
    return Movers(
        np.zeros(k, np.int64), np.zeros(k + 1, np.int64), np.zeros(n, np.int64), np.zeros(n), np.zeros(1, np.int64)
    )


@kernel
def list_movers(movers: Movers, points: Points, flag: Array) -> None:
    """Fill the lists for the flagged points."""
    count, total = 0, 0
    for k in range(len(points.nodes)):
        first = total
        for index in range(points.begin[k], points.begin[k + 1]):
            if flag[points.point[index]]:
                movers.point[total], movers.share[total] = points.point[index], points.share[index]
                total += 1
        if total > first:
            movers.node[count], movers.begin[count] = points.nodes[k], first
            count += 1
    movers.begin[count], movers.count[0] = total, count


@kernel
def share_out(movers: Movers, value: Array, out: Array, stride: int, first: int, crew: Crew) -> None:
    """Add the points' numbers (S, 3) to the nodes: node n has row n * stride + first of `out`."""
    lo, hi = share(movers.count[0], crew.thread, crew.n_threads)
    for k in range(lo, hi):
        n, a, b, c = movers.node[k] * stride + first, 0.0, 0.0, 0.0
        for index in range(movers.begin[k], movers.begin[k + 1]):
            s, w = movers.point[index], movers.share[index]
            a, b, c = a + w * value[s, 0], b + w * value[s, 1], c + w * value[s, 2]
        out[n, 0] += a
        out[n, 1] += b
        out[n, 2] += c


@kernel
def place(points: Points, s: int, u: Array, stride: int, first: int) -> Any:
    """Return sum_n w_sn u_n of a point; node n has row n * stride + first."""
    a, b, c = 0.0, 0.0, 0.0
    for k in range(points.node.shape[1]):
        w, n = points.weight[s, k], points.node[s, k] * stride + first
        a, b, c = a + w * u[n, 0], b + w * u[n, 1], c + w * u[n, 2]
    return a, b, c


@kernel
def places(points: Points, rest: Array, s: int, u: Array, v: Array) -> Any:
    """Return the position and the velocity of a point, for displacements u and velocities v of the nodes."""
    x, y, z, a, b, c = rest[s, 0], rest[s, 1], rest[s, 2], 0.0, 0.0, 0.0
    for k in range(points.node.shape[1]):
        w, n = points.weight[s, k], points.node[s, k]
        x, y, z = x + w * u[n, 0], y + w * u[n, 1], z + w * u[n, 2]
        a, b, c = a + w * v[n, 0], b + w * v[n, 1], c + w * v[n, 2]
    return (x, y, z), (a, b, c)


@kernel
def add_weight_bars(
    points: Points, bars: SurfaceBars, s: int, at: NodeStep, pairs: Array, x_bar: Any, v_bar: Any, force: Any
) -> None:
    """Add the cotangents of a point's rest position and weights in a substep.

    x = X + sum w u,  v = sum w v_n,  f_n = w f: those of a weight are x_bar . u_n + v_bar . v_n + f . p_n, with the
    cotangent p_n of the force on a node, the second record in `pairs`.
    """
    for d in range(3):
        bars.rest[s, d] += x_bar[d]
    for k in range(points.node.shape[1]):
        n, total = points.node[s, k], 0.0
        for d in range(3):
            total += x_bar[d] * at.u[n, d] + v_bar[d] * at.v[n, d] + force[d] * pairs[2 * n + 1, d]
        bars.weight[s, k] += total


@kernel
def put(a: Array, s: int, value: Any) -> None:
    """Write a vector."""
    a[s, 0], a[s, 1], a[s, 2] = value


@kernel
def farthest(points: Points, u: Array, mark: Array, crew: Crew) -> float:
    """Return the largest square of a node's way from `mark` (K, 3) to u, of the nodes that are this thread's."""
    lo, hi = share(len(points.nodes), crew.thread, crew.n_threads)
    most = 0.0
    for k in range(lo, hi):
        n = points.nodes[k]
        a, b, c = u[n, 0] - mark[k, 0], u[n, 1] - mark[k, 1], u[n, 2] - mark[k, 2]
        most = max(most, a * a + b * b + c * c)
    return most


@kernel
def set_mark(points: Points, u: Array, mark: Array, crew: Crew) -> None:
    """Keep the displacements of the nodes that are this thread's."""
    lo, hi = share(len(points.nodes), crew.thread, crew.n_threads)
    for k in range(lo, hi):
        for d in range(3):
            mark[k, d] = u[points.nodes[k], d]


@kernel
def load_spring(u: Array, v: Array, row: int, s: int) -> Any:
    """Return spring s; the rows of springs begin at `row`, and odd springs are in v."""
    i = row + s // 2
    if s % 2 == 0:
        return float(u[i, 0]), float(u[i, 1]), float(u[i, 2])
    return float(v[i, 0]), float(v[i, 1]), float(v[i, 2])


@kernel
def store_spring(u: Array, v: Array, row: int, s: int, value: Any) -> None:
    """Write spring s."""
    if s % 2 == 0:
        put(u, row + s // 2, value)
    else:
        put(v, row + s // 2, value)
