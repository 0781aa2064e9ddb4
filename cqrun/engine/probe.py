"""Record weighted sums of particles at control steps, and the adjoint. One thread runs these.

A row with few particles (a marker) is summed one by one. A row with many (a body's centroid) is summed by lanes, which
is 25 times as fast: particles whose columns have the same remainder by PADDING go into one partial sum, for any
precision and width of a lane, and the partial sums are added at the end.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from cqrun.engine.setting import Probe
from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import LANE_BYTES, as_real
from cqrun.numerics.packed import aligned, load, store
from cqrun.numerics.wide_records import load_wide, store_wide
from cqrun.plugin.contract import Array
from cqrun.state import PADDING

MANY = 64
"""Number of particles from which a row is summed by lanes."""


def make_probe(matrix: sparse.csr_array, columns: Array, rows: int) -> Probe:
    """Return the probe of a matrix (K, N), for the kernel columns (N,) of particles and the rows of the state."""
    counts = np.diff(matrix.indptr)
    many = np.flatnonzero(counts >= MANY)
    few = np.repeat(counts < MANY, counts)
    start = np.concatenate([[0], np.cumsum(np.where(counts < MANY, counts, 0))])
    runs, shares = [], [np.zeros((0, PADDING))]
    for k in many:
        entries = slice(matrix.indptr[k], matrix.indptr[k + 1])
        column = columns[matrix.indices[entries]]
        blocks, block = np.unique(column // PADDING, return_inverse=True)
        share = np.zeros((len(blocks), PADDING))
        np.add.at(share, (block, column % PADDING), matrix.data[entries])
        runs.append(blocks)
        shares.append(share)
    table = np.concatenate(shares).reshape(-1, 4)
    records = aligned(table.shape, table.dtype)
    records[...] = table
    return Probe(
        start.astype(np.int64),
        columns[matrix.indices[few]].astype(np.int64),
        matrix.data[few].astype(np.float64),
        many.astype(np.int64),
        np.cumsum([0, *map(len, runs)]).astype(np.int64),
        np.concatenate([*runs, np.zeros(0)]).astype(np.int64),
        records,
        aligned((rows * PADDING // 4, 4), np.float64),
    )


@kernel
def record(probe: Probe, q: Array, out: Array) -> None:
    """out[row, k] = sum_p W[k, p] q[row, p], q packed."""
    width = LANE_BYTES // q.itemsize
    parts = PADDING // width
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
            for part in range(parts):
                i = probe.runs[index] * PADDING + part * width
                share = load_wide(probe.shares, index * parts + part, as_real(load(q, 0, i), sums))
                for row in range(q.shape[1]):
                    a, at = as_real(load(q, row, i), sums), row * parts + part
                    store_wide(sums, at, load_wide(sums, at, a) + share * a)
        for row in range(q.shape[1]):
            total = 0.0
            for part in range(row * PADDING // 4, (row + 1) * PADDING // 4):
                for place in range(4):
                    total += sums[part, place]
            out[row, probe.rows[j]] = total


@kernel
def record_vjp(probe: Probe, q_bar: Array, out_bar: Array) -> None:
    """Add the cotangent of a record to that of the state."""
    width = LANE_BYTES // q_bar.itemsize
    parts = PADDING // width
    for row in range(q_bar.shape[1]):
        for k in range(len(probe.start) - 1):
            bar = out_bar[row, k]
            for index in range(probe.start[k], probe.start[k + 1]):
                p = probe.columns[index]
                q_bar[p // width, row, p % width] += probe.weights[index] * bar
    for j in range(len(probe.rows)):
        for index in range(probe.begin[j], probe.begin[j + 1]):
            for part in range(parts):
                i = probe.runs[index] * PADDING + part * width
                share = load_wide(probe.shares, index * parts + part, as_real(load(q_bar, 0, i), probe.shares))
                for row in range(q_bar.shape[1]):
                    bar = out_bar[row, probe.rows[j]]
                    if bar != 0.0:  # most terms use only some of x, v, C and F
                        added = as_real(load(q_bar, row, i), probe.shares) + share * bar
                        store(q_bar, row, i, as_real(added, q_bar))
