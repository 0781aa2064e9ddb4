"""The inverse cube root on lanes: as exact as a number can be, and NaN where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import lane_width
from cqrun.numerics.packed import load, pack, store, unpack
from cqrun.numerics.roots import inverse_cube_root


@kernel
def roots_of(table, out, width):
    for i in range(0, table.shape[0] * width, width):
        store(out, 0, i, inverse_cube_root(load(table, 0, i)))


@needs_jit
@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_the_root_is_exact_over_all_exponents(real, rng):
    width, tiny = lane_width(real), 30 if real == np.float32 else 300
    a = np.concatenate(
        [np.geomspace(10.0**-tiny, 10.0**tiny, 1000), np.linspace(0.9, 1.1, 1000), [1.0, 8.0, 0.125] * 8]
    )
    a = a[: len(a) // (2 * width) * 2 * width].astype(real).astype(float)
    table = pack(a[None], real)
    out = np.zeros_like(table)
    roots_of(table, out, width)
    found = unpack(out)[0]
    assert np.abs(found * np.cbrt(a) - 1.0).max() < 4 * np.finfo(real).eps
    assert inverse_cube_root(a) == pytest.approx(np.cbrt(a) ** -1.0, rel=1e-14)


@needs_jit
def test_what_is_not_positive_has_none():
    width = lane_width(np.float64)
    table = pack(np.resize([-1.0, 0.0, np.nan, -1e300], 2 * width)[None], np.float64)
    out = np.zeros_like(table)
    roots_of(table, out, width)
    assert np.isnan(unpack(out)).all()
    assert np.isnan(inverse_cube_root(np.array([-1.0, 0.0]))).all()
    assert inverse_cube_root(np.array([8.0 + 1e-30j])).imag == pytest.approx(-1e-30 / 3 / 16, rel=1e-12)
