"""Eigenvalues and eigenvectors of symmetric matrices: distinct, nearly equal and equal ones, on numbers and lanes."""

from __future__ import annotations

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.numerics.compile import kernel
from cqrun.numerics.eigen import eigen
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import load, pack, store, unpack

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])


def matrices(dim, rng):
    """Return symmetric positive matrices (n, D, D), with eigenvalues apart, almost together, and equal."""
    values = [rng.uniform(0.1, 5.0, (200, dim))]
    for apart in (1e-1, 1e-4, 1e-8, 1e-12, 1e-15, 0.0):
        values.append(1.3 * (1.0 + apart * rng.uniform(-1, 1, (20, dim))))  # all together
        values.append(np.concatenate([values[-1][:, :-1], rng.uniform(0.2, 4.0, (20, 1))], axis=1))  # all but one
    values = np.concatenate(values)
    Q = np.linalg.qr(rng.normal(size=(len(values), dim, dim)))[0]
    A = np.einsum("nij,nj,nkj->nik", Q, values, Q)
    A = np.concatenate([A, [np.eye(dim), np.diag([2.0] + [1.0] * (dim - 1)), np.diag([1.0] * (dim - 1) + [2.0])]])
    return 0.5 * (A + np.swapaxes(A, 1, 2)), np.linalg.eigvalsh(A)


def found(entries, dim):
    """Return values (n, D) and vectors (n, D, D) of tuples of arrays."""
    values, Q = entries
    return np.array(values).T, np.array(Q).T.reshape(-1, dim, dim)


def check(A, expected, values, Q, eps):
    dim = A.shape[1]
    size = np.abs(expected).max(axis=1)[:, None]
    assert (np.abs(np.sort(values, axis=1) - expected) / size).max() < 20 * eps
    assert np.abs(np.swapaxes(Q, 1, 2) @ Q - np.eye(dim)).max() < 20 * eps
    back = np.einsum("nij,nj,nkj->nik", Q, values, Q)
    assert (np.abs(back - A) / size[:, :, None]).max() < 20 * eps


@DIM
def test_plain(dim, rng):
    A, expected = matrices(dim, rng)
    check(A, expected, *found(eigen(tuple(A.reshape(len(A), -1).T)), dim), np.finfo(float).eps)


@kernel
def on_lanes(table, out, width, dims):
    for i in range(0, table.shape[0] * width, width):
        if len(dims) == 2:
            A = (load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i))
        else:
            A = (
                load(table, 0, i), load(table, 1, i), load(table, 2, i), load(table, 3, i), load(table, 4, i),
                load(table, 5, i), load(table, 6, i), load(table, 7, i), load(table, 8, i),
            )  # fmt: skip
        values, Q = eigen(A)
        row = 0
        for entry in values:
            store(out, row, i, entry)
            row += 1
        for entry in Q:
            store(out, row, i, entry)
            row += 1


@needs_jit
@pytest.mark.parametrize("real", [np.float64, np.float32])
@DIM
def test_lanes(dim, real, rng):
    A, _ = matrices(dim, rng)
    n = lane_width(real)
    A = np.resize(A, (-(-len(A) // n) * n, dim, dim)).astype(real).astype(float)
    table = pack(A.reshape(len(A), -1).T, real)
    out = np.zeros((table.shape[0], dim + dim * dim, n), real)
    on_lanes(table, out, n, (0,) * dim)
    rows = unpack(out).astype(float)
    check(A, np.linalg.eigvalsh(A), *found((rows[:dim], rows[dim:]), dim), float(np.finfo(real).eps))
