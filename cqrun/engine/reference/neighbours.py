"""Find which facets of other bodies are near a point, by a spatial hash (M. Teschner et al., VMV 2003)."""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.engine.reference.facet import nearest_on, row
from cqrun.engine.reference.meeting import Meeting
from cqrun.engine.reference.setting import NodeRun
from cqrun.engine.reference.touch import at_rest, place, put
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import barrier, kernel, share
from cqrun.numerics.tensor import add
from cqrun.plugin.contract import Array

FAR = 1e300


@kernel
def watch_pairs(meeting: Meeting, run: NodeRun, u: Array, crew: Crew) -> bool:
    """Find the facets near points again if nodes have moved too far; return whether that was done."""
    pairs, points = meeting.pairs, meeting.surface.points
    lo, hi = share(len(points.nodes), crew.thread, crew.n_threads)
    most = 0.0
    for k in range(lo, hi):
        n, square = points.nodes[k], 0.0
        for d in range(3):
            square += (u[n, d] - pairs.mark[k, d]) ** 2
        most = max(most, square)
    pairs.moved[crew.thread] = most
    barrier(run.arrivals, crew.n_threads)
    for thread in range(crew.n_threads):
        most = max(most, pairs.moved[thread])
    if not most > pairs.reach**2:
        return False
    for k in range(lo, hi):
        for d in range(3):
            pairs.mark[k, d] = u[points.nodes[k], d]
    lo, hi = share(len(pairs.flag), crew.thread, crew.n_threads)
    for s in range(lo, hi):
        put(meeting.x, s, add(at_rest(meeting.surface, s), place(meeting.surface, s, u, 1, 0)))
    barrier(run.arrivals, crew.n_threads)
    if crew.thread == 0:
        bound_bodies(meeting)
        hash_facets(meeting)
    barrier(run.arrivals, crew.n_threads)
    for s in range(lo, hi):
        find_facets(meeting, s)
    barrier(run.arrivals, crew.n_threads)
    if crew.thread == 0:
        list_pairs(meeting)
    barrier(run.arrivals, crew.n_threads)
    return True


@kernel
def bound_bodies(meeting: Meeting) -> None:
    """Find the box of each body."""
    begin, box, x = meeting.facets.begin, meeting.hash.box, meeting.x
    for body in range(len(box)):
        for d in range(3):
            low, high = FAR, -FAR
            for s in range(begin[body], begin[body + 1]):
                low, high = min(low, x[s, d]), max(high, x[s, d])
            box[body, d], box[body, 3 + d] = low, high


@kernel
def near_another(meeting: Meeting, body: int, x: Any, margin: float) -> bool:
    """Return whether x is within a margin of the box of a body other than its own."""
    box = meeting.hash.box
    for other in range(len(box)):
        if other != body:
            inside = True
            for d in range(3):
                inside = inside and box[other, d] - margin <= x[d] <= box[other, 3 + d] + margin
            if inside:
                return True
    return False


@kernel
def centroid(meeting: Meeting, f: int) -> Any:
    """Return the mean of a facet's vertices."""
    corner, n = meeting.facets.corner, meeting.facets.corner.shape[1]
    a, b, c = 0.0, 0.0, 0.0
    for v in range(n):
        s = corner[f, v]
        a, b, c = a + meeting.x[s, 0], b + meeting.x[s, 1], c + meeting.x[s, 2]
    return a / n, b / n, c / n


@kernel
def bucket_of(i: int, j: int, k: int, n_buckets: int) -> int:
    """Return the bucket of a cell."""
    return ((i * 73856093) ^ (j * 19349663) ^ (k * 83492791)) & (n_buckets - 1)


@kernel
def cell_of(x: float, size: float) -> int:
    """Return the number of a coordinate's cell."""
    return int(np.floor(x / size))


@kernel
def hash_facets(meeting: Meeting) -> None:
    """Sort the facets that are near another body into buckets."""
    facets, table, margin = meeting.facets, meeting.hash, meeting.pairs.margin
    n_buckets, widest = len(table.begin) - 1, 0.0
    for f in range(len(facets.corner)):
        centre = centroid(meeting, f)
        for v in range(facets.corner.shape[1]):
            square = 0.0
            for d in range(3):
                square += (meeting.x[facets.corner[f, v], d] - centre[d]) ** 2
            widest = max(widest, square)
    widest = np.sqrt(widest)
    size = margin + widest
    table.size[0], table.size[1] = size, widest
    table.begin[:] = 0
    for f in range(len(facets.corner)):
        centre = centroid(meeting, f)
        table.bucket[f] = -1
        if near_another(meeting, facets.body[facets.corner[f, 0]], centre, size):
            for d in range(3):
                table.cell[f, d] = cell_of(centre[d], size)
            table.bucket[f] = bucket_of(table.cell[f, 0], table.cell[f, 1], table.cell[f, 2], n_buckets)
            table.begin[table.bucket[f] + 1] += 1
    for b in range(n_buckets):
        table.begin[b + 1] += table.begin[b]
    for f in range(len(facets.corner)):
        b = table.bucket[f]
        if b >= 0:
            table.order[table.begin[b]] = f
            table.begin[b] += 1
    for b in range(n_buckets, 0, -1):  # begin[b] has moved on to where the next bucket begins
        table.begin[b] = table.begin[b - 1]
    table.begin[0] = 0


@kernel
def find_facets(meeting: Meeting, s: int) -> None:
    """Find the facets of other bodies within the margin of a point."""
    facets, table, pairs = meeting.facets, meeting.hash, meeting.pairs
    body, x, n_buckets, size = facets.body[s], row(meeting.x, s), len(table.begin) - 1, table.size[0]
    pairs.many[s] = 0
    if not near_another(meeting, body, x, pairs.margin):
        return
    i, j, k = cell_of(x[0], size), cell_of(x[1], size), cell_of(x[2], size)
    depth = 1 if facets.corner.shape[1] == 3 else 0
    for a in range(i - 1, i + 2):
        for b in range(j - 1, j + 2):
            for c in range(k - depth, k + depth + 1):
                bucket = bucket_of(a, b, c, n_buckets)
                for index in range(table.begin[bucket], table.begin[bucket + 1]):
                    f = table.order[index]
                    if table.cell[f, 0] != a or table.cell[f, 1] != b or table.cell[f, 2] != c:
                        continue
                    if facets.body[facets.corner[f, 0]] != body:
                        _, square = nearest_on(facets.corner, f, x, meeting.x)
                        if square < pairs.margin**2:
                            keep_facet(pairs.facets, pairs.square, pairs.many, s, f, square)


@kernel
def keep_facet(facets: Array, squares: Array, many: Array, s: int, f: int, square: float) -> None:
    """Insert a facet into a point's list, which is sorted by distance and keeps the nearest."""
    at = many[s]
    if at == facets.shape[1]:
        if square >= squares[s, at - 1]:
            return
        at -= 1
    many[s] = at + 1
    while at > 0 and squares[s, at - 1] > square:
        facets[s, at], squares[s, at] = facets[s, at - 1], squares[s, at - 1]
        at -= 1
    facets[s, at], squares[s, at] = f, square


@kernel
def list_pairs(meeting: Meeting) -> None:
    """List the points with facets near them, all points that take part, and the nodes that move one of them."""
    pairs, corner, points = meeting.pairs, meeting.facets.corner, meeting.surface.points
    pairs.flag[:] = False
    count = 0
    for s in range(len(pairs.flag)):
        if pairs.many[s] > 0:
            pairs.points[count] = s
            count += 1
            pairs.flag[s] = True
            for index in range(pairs.many[s]):
                for v in range(corner.shape[1]):
                    pairs.flag[corner[pairs.facets[s, index], v]] = True
    pairs.count[0], count = count, 0
    for s in range(len(pairs.flag)):
        if pairs.flag[s]:
            pairs.active[count] = s
            count += 1
    pairs.count[1], count = count, 0
    for k in range(len(points.nodes)):
        for index in range(points.begin[k], points.begin[k + 1]):
            if pairs.flag[points.point[index]]:
                pairs.nodes[count] = k
                count += 1
                break
    pairs.count[2] = count
