"""Logarithm and exponential of lanes against NumPy's, over all exponents and at the edges."""

from __future__ import annotations

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.numerics.compile import kernel
from cqrun.numerics.elementary import exponential, logarithm
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import load, pack, store, unpack

REALS = pytest.mark.parametrize("real", [np.float64, np.float32])


@kernel
def both_of(table, out, width):
    for i in range(0, table.shape[0] * width, width):
        store(out, 0, i, logarithm(load(table, 0, i)))
        store(out, 1, i, exponential(load(table, 0, i)))


def of(a, real):
    """Return logarithm and exponential of numbers (n,), on lanes."""
    n = lane_width(real)
    padded = np.resize(a, -(-len(a) // n) * n)
    table = pack(padded[None], real)
    out = np.zeros((table.shape[0], 2, n), real)
    both_of(table, out, n)
    return unpack(out)[:, : len(a)]


@needs_jit
@REALS
def test_both_are_exact_to_two_units_of_the_last_place(real, rng):
    eps, end = float(np.finfo(real).eps), 80.0 if real == np.float32 else 700.0
    a = np.concatenate([rng.uniform(-end, end, 4000), rng.uniform(-1, 1, 4000)]).astype(real).astype(float)
    assert np.abs(of(a, real)[1] / np.exp(a) - 1.0).max() < 2 * eps
    a = np.exp(a).astype(real).astype(float)
    wanted = np.log(a)
    assert (np.abs(of(a, real)[0] - wanted) / np.maximum(np.abs(wanted), 1e-3)).max() < 2 * eps
    near = (1.0 + np.concatenate([rng.uniform(-1, 1, 400), [0.0]]) * 1e-4).astype(real).astype(float)
    assert of(near, real)[0] == pytest.approx(np.log(near), rel=2 * eps, abs=1e-300)  # a small stretch keeps its digits


@needs_jit
@REALS
def test_edges(real):
    log, exp = of(np.array([0.0, -1.0, np.nan, 1.0]), real)
    assert np.isnan(log[:3]).all()
    assert log[3] == 0.0
    assert exp[0] == 1.0
    assert np.isnan(exp[2])
    assert of(np.array([-1e4, 1e4, np.inf, -np.inf]), real)[1].tolist() == [0.0, np.inf, np.inf, 0.0]
