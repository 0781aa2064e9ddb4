"""What a probe records: sums over few particles and over many, and the adjoint."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse

from cqrun.engine.probe import MANY, make_probe, record, record_vjp
from cqrun.numerics.packed import pack, unpack
from cqrun.state import PADDING

ROWS = 12


@pytest.fixture(params=[np.float64, np.float32], ids=["float64", "float32"])
def case(request, rng):
    """Return a matrix with rows of none, one, few, nearly many, many and all particles; columns; a packed state."""
    real, n = request.param, 5 * MANY
    counts = [0, 1, 5, MANY - 1, MANY, 2 * MANY + 3, n]
    dense = np.zeros((len(counts), n))
    for row, count in zip(dense, counts, strict=True):
        row[rng.permutation(n)[:count]] = rng.normal(size=count)
    columns = np.concatenate([np.arange(n // 2), np.arange(n // 2, n) + PADDING])  # two bodies, one of them padded
    q = pack(rng.normal(size=(ROWS, n + PADDING)), real)
    return make_probe(sparse.csr_array(dense), columns, ROWS), dense, columns, q


def test_it_records_every_row(case):
    probe, dense, columns, q = case
    out = np.full((ROWS, len(dense)), np.nan)
    record(probe, q, out)
    np.testing.assert_allclose(out, unpack(q)[:, columns] @ dense.T, rtol=1e-12, atol=1e-12)
    assert len(probe.rows) == 3


def test_sums_do_not_depend_on_how_long_lanes_are(case):
    """The lanes of float32 are twice as many as those of float64."""
    probe, dense, _, q = case
    table = unpack(q).astype(np.float32).astype(np.float64)
    sums = []
    for real in (np.float32, np.float64):
        sums.append(np.zeros((ROWS, len(dense))))
        record(probe, pack(table, real), sums[-1])
    np.testing.assert_array_equal(*sums)


def test_the_adjoint_is_the_transpose(case, rng):
    """<out_bar, record(q)> = <record_vjp(out_bar), q>, and what is not asked for is left as it is."""
    probe, dense, columns, q = case
    out_bar = rng.normal(size=(ROWS, len(dense)))
    out_bar[ROWS // 2 :] = 0.0
    q_bar = np.zeros_like(q)
    record_vjp(probe, q_bar, out_bar)
    expected = np.zeros((ROWS, q.shape[0] * q.shape[2]))
    expected[:, columns] = out_bar @ dense
    tolerance = 1e-6 if q.dtype == np.float32 else 1e-13
    np.testing.assert_allclose(unpack(q_bar), expected, rtol=tolerance, atol=tolerance)
    assert not unpack(q_bar)[ROWS // 2 :].any()
    if q.dtype == np.float64:
        out = np.zeros((ROWS, len(dense)))
        record(probe, q, out)
        assert np.sum(out_bar * out) == pytest.approx(np.sum(q_bar * q), rel=1e-12)


def test_without_rows_nothing_is_recorded(case):
    *_, q = case
    probe = make_probe(sparse.csr_array((0, 3)), np.arange(3), ROWS)
    out, q_bar = np.zeros((ROWS, 0)), np.ones_like(q)
    record(probe, q, out)
    record_vjp(probe, q_bar, out)
    assert np.all(q_bar == 1.0)
