"""Recording weighted sums of particles at control steps, and the adjoint. One thread runs these.

A row of few particles (a marker) is summed one by one. One of many (a body's centroid) takes whole lanes, each place
of a lane into a sum of its own, so that a compiler can take all places at once: 25 times as fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from cqrun.compile import kernel
from cqrun.contract import Array
from cqrun.engine.setting import Probe

if TYPE_CHECKING:
    from scipy import sparse

MANY = 64
"""Particles from which a row is summed by lanes."""


def make_probe(matrix: sparse.csr_array, columns: Array, rows: int, width: int) -> Probe:
    """Return the probe of a matrix (K, N).

    Args:
        columns: the kernel column of each particle (N,).
        rows: of the packed state q.
        width: of its lanes.
    """
    counts = np.diff(matrix.indptr)
    many = np.flatnonzero(counts >= MANY)
    few = np.repeat(counts < MANY, counts)
    start = np.concatenate([[0], np.cumsum(np.where(counts < MANY, counts, 0))])
    lanes, shares = [], []
    for k in many:
        own = slice(matrix.indptr[k], matrix.indptr[k + 1])
        place = columns[matrix.indices[own]]
        held, which = np.unique(place // width, return_inverse=True)
        share = np.zeros((len(held), width))
        np.add.at(share, (which, place % width), matrix.data[own])
        lanes.append(held)
        shares.append(share)
    return Probe(
        start.astype(np.int64),
        columns[matrix.indices[few]].astype(np.int64),
        matrix.data[few].astype(np.float64),
        many.astype(np.int64),
        np.cumsum([0, *map(len, lanes)]).astype(np.int64),
        np.concatenate([*lanes, np.zeros(0)]).astype(np.int64),
        np.concatenate([*shares, np.zeros((0, width))]),
        np.zeros((rows, width)),
    )


@kernel
def record(probe: Probe, q: Array, out: Array) -> None:
    """out[row, k] = sum_p W[k, p] q[row, p], q packed."""
    width = q.shape[2]
    for row in range(q.shape[1]):
        for k in range(len(probe.start) - 1):
            total = 0.0
            for index in range(probe.start[k], probe.start[k + 1]):
                p = probe.columns[index]
                total += probe.weights[index] * q[p // width, row, p % width]
            out[row, k] = total
    sums = probe.sums
    for j in range(len(probe.rows)):
        sums[:] = 0.0
        for index in range(probe.begin[j], probe.begin[j + 1]):
            lane = probe.lanes[index]
            for row in range(q.shape[1]):
                for place in range(width):
                    sums[row, place] += probe.shares[index, place] * q[lane, row, place]
        for row in range(q.shape[1]):
            total = 0.0
            for place in range(width):
                total += sums[row, place]
            out[row, probe.rows[j]] = total


@kernel
def record_vjp(probe: Probe, q_bar: Array, out_bar: Array) -> None:
    """Add the cotangent of a record to that of the state."""
    width = q_bar.shape[2]
    for row in range(q_bar.shape[1]):
        for k in range(len(probe.start) - 1):
            bar = out_bar[row, k]
            for index in range(probe.start[k], probe.start[k + 1]):
                p = probe.columns[index]
                q_bar[p // width, row, p % width] += probe.weights[index] * bar
    for j in range(len(probe.rows)):
        for index in range(probe.begin[j], probe.begin[j + 1]):
            lane = probe.lanes[index]
            for row in range(q_bar.shape[1]):
                bar = out_bar[row, probe.rows[j]]
                if bar != 0.0:  # most terms ask for some of x, v, C and F
                    for place in range(width):
                        q_bar[lane, row, place] += probe.shares[index, place] * bar
