"""Lane values, compiled, against what each function does in plain Python; packing; records of four."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.numerics import packed
from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import (
    LANE_BYTES,
    all_lanes,
    as_real,
    exp,
    floor,
    lane,
    lane_width,
    log,
    select,
    sqrt,
    with_lane,
)
from cqrun.numerics.packed import LINE, accumulate, aligned, load, pack, store, unpack
from cqrun.numerics.records import load4, load_quads, make4, store4, store_quads
from cqrun.numerics.wide_records import (
    filled,
    load_each,
    load_neighbours,
    load_pairs,
    load_records,
    load_wide,
    prefetch_each,
    records_in_lane,
    spread,
    store_neighbours,
    store_wide,
    sums,
)

REALS = pytest.mark.parametrize("real", [np.float64, np.float32])
ROWS_OUT = 14


@kernel
def one_lane(table, out, i):
    """Use every function of lanes once; what a row of `out` holds stands in `expected`."""
    a, b = load(table, 0, i), load(table, 1, i)
    store(out, 0, i, a + b * 2 - 1.5 / a)
    store(out, 1, i, -(3 - a) / (b + 2.0))
    store(out, 2, i, floor(a))
    store(out, 3, i, sqrt(a * a + b * b))
    store(out, 4, i, log(a * a))
    store(out, 5, i, exp(b))
    store(out, 6, i, select(a > b, a, b))
    store(out, 7, i, select((a < 0.5) & (b > -0.5), 1.0, b))
    store(out, 8, i, with_lane(a, 2, lane(b, 1)))
    store(out, 9, i, 7.0)
    accumulate(out, 9, i, a)
    store(out, 10, i, select(a > 1e9, a, 0.25))
    store(out, 11, i, a * 0.0 + (1.0 if all_lanes(a * a > -1.0) else 0.0))
    store(out, 12, i, a * 0.0 + (1.0 if all_lanes(a > b) else 0.0))
    store(out, 13, i, select(a > b, 2, a))


def expected(a, b):
    """Return the rows of `one_lane` in NumPy."""
    return np.array([
        a + b * 2 - 1.5 / a, -(3 - a) / (b + 2.0), np.floor(a), np.hypot(a, b), np.log(a * a), np.exp(b),
        np.maximum(a, b), np.where((a < 0.5) & (b > -0.5), 1.0, b), np.where(np.arange(len(a)) == 2, b[1], a),
        7.0 + a, np.full(len(a), 0.25), np.ones(len(a)), np.full(len(a), float(np.all(a > b))), np.where(a > b, 2, a),
    ])  # fmt: skip


@REALS
@pytest.mark.parametrize("body", [one_lane, getattr(one_lane, "py_func", one_lane)], ids=["compiled", "plain"])
def test_functions_of_lanes(real, body, rng):
    width = lane_width(real)
    table = rng.uniform(-1.9, 2.0, (2, 3 * width)).astype(real)
    out = np.zeros((3, ROWS_OUT, width), real)
    for i in range(0, 3 * width, width):
        body(pack(table, real), out, i)
    got = unpack(out)
    for k in range(3):
        piece = slice(k * width, (k + 1) * width)
        want = expected(*table[:, piece].astype(float))
        np.testing.assert_allclose(got[:, piece], want, rtol=30 * np.finfo(real).eps, atol=10 * np.finfo(real).eps)


@kernel
def not_numbers(table, out, i):
    """What guards need of NaN: it is neither inside nor outside, and survives arithmetic."""
    a, zero = load(table, 0, i), load(table, 1, i)
    store(out, 0, i, select(a < 1.0, zero + 1.0, 0.0))
    store(out, 1, i, select(a > -1.0, zero + 1.0, 0.0))
    store(out, 2, i, a * 0.0 + 1.0)
    store(out, 3, i, 1.0 if all_lanes((a > -1.0) & (a < 1.0)) else 0.0)


@REALS
def test_nan_and_infinity_are_not_compiled_away(real):
    """`nnan` and `ninf` would be free to: the guards of a rollout stand on this."""
    width = lane_width(real)
    values = np.zeros((2, 3 * width))
    values[0, 1], values[0, width + 3] = np.nan, np.inf
    out = np.zeros((3, 4, width), real)
    with np.errstate(invalid="ignore"):
        for i in range(0, 3 * width, width):
            not_numbers(pack(values, real), out, i)
        rows = unpack(out)
    assert list(rows[:2, 1]) == [0.0, 0.0]
    assert np.isnan(rows[2, 1])
    assert list(rows[:2, width + 3]) == [0.0, 1.0]
    assert np.isnan(rows[2, width + 3])
    inside = rows[3].reshape(3, width)
    np.testing.assert_array_equal(inside, np.array([[0.0], [0.0], [1.0]]) * np.ones(width))


@REALS
def test_packing_is_undone_by_unpacking(real, rng):
    width = lane_width(real)
    table = rng.normal(size=(5, 4 * width)).astype(real)
    once = pack(table, real)
    assert once.shape == (4, 5, width)
    assert once.flags.c_contiguous
    np.testing.assert_array_equal(unpack(once), table)
    np.testing.assert_array_equal(once[2, 3], table[3, 2 * width : 3 * width])


@kernel
def records(a, b, out, i):
    """Move records about: entry by entry, and as many as a lane is wide."""
    x, y, z, w = load_quads(a, i)
    store_quads(out, i, w, x, y + z, 3.0)
    store4(b, 1, load4(a, 0) + make4(1.0, 2.0, 3, 4.0, a))
    store4(b, 2, 5.0)


@REALS
@pytest.mark.parametrize("body", [records, getattr(records, "py_func", records)], ids=["compiled", "plain"])
def test_records_of_four(real, body, rng):
    width = lane_width(real)
    a, b, out = rng.normal(size=(3 * width, 4)).astype(real), np.zeros((4, 4), real), np.zeros((3 * width, 4), real)
    body(a, b, out, width)
    piece = slice(width, 2 * width)
    np.testing.assert_array_equal(out[piece, 0], a[piece, 3])
    np.testing.assert_array_equal(out[piece, 1], a[piece, 0])
    np.testing.assert_allclose(out[piece, 2], a[piece, 1] + a[piece, 2], rtol=np.finfo(real).eps)
    np.testing.assert_array_equal(out[piece, 3], 3.0)
    np.testing.assert_array_equal(np.delete(out, np.r_[piece], axis=0), 0.0)
    np.testing.assert_allclose(b[1], a[0] + np.array([1, 2, 3, 4], real), rtol=np.finfo(real).eps)
    np.testing.assert_array_equal(b[[0, 2, 3]], np.array([[0] * 4, [5] * 4, [0] * 4], real))


@kernel
def side_by_side(a, nodes, out):
    """Compute on several records at once."""
    count = records_in_lane(a)
    store_neighbours(out, 0, load_records(a, nodes, 1))
    store_neighbours(out, count, spread(load_neighbours(a, 3), 1))
    store_neighbours(out, 2 * count, sums(load_neighbours(a, 0), load_neighbours(a, 1), load_neighbours(a, 2)))
    store_neighbours(out, 3 * count, filled(2.5, a))
    first, second = load_pairs(a, nodes, -1)
    store_neighbours(out, 4 * count, first)
    store_neighbours(out, 5 * count, second)


@REALS
@pytest.mark.parametrize("body", [side_by_side, getattr(side_by_side, "py_func", side_by_side)], ids=["jit", "plain"])
def test_records_side_by_side(real, body, rng):
    count = lane_width(real) // 4
    a, out = rng.normal(size=(20, 4)).astype(real), np.zeros((7 * count, 4), real)
    nodes = (7, 2, 2, 8)[:count]
    body(a, nodes, out)
    got = out.reshape(7, count, 4)
    np.testing.assert_array_equal(got[0], a[np.array(nodes) + 1])
    np.testing.assert_array_equal(got[1], np.repeat(a[3 : 3 + count, 1:2], 4, axis=1))
    total = (a[:, 0] + a[:, 1]) + (a[:, 2] + a[:, 3])
    for k in range(3):
        np.testing.assert_array_equal(got[2][:, k], total[k : k + count])
    np.testing.assert_array_equal(got[2][:, 3], 0.0)
    np.testing.assert_array_equal(got[3], 2.5)
    np.testing.assert_array_equal(got[4:6], a[2 * (np.array(nodes) - 1) + [[0], [1]]])
    np.testing.assert_array_equal(got[6], 0.0)


@kernel
def together(a, b, one, two):
    """Add to entries of one record and of two."""
    x, y = load_each((a,), 3), load_each((a, b), 3)
    store_wide(one, 2, load_wide(one, 2, x) + x)
    store_wide(two, 2, load_wide(two, 2, y) + y * 2.0)


@REALS
@pytest.mark.parametrize("body", [together, getattr(together, "py_func", together)], ids=["compiled", "plain"])
def test_records_of_two_arrays_as_one_value(real, body, rng):
    a, b, one, two = (rng.normal(size=(n, 4)).astype(real) for n in (5, 5, 4, 8))
    one_after, two_after = one.copy(), two.copy()
    one_after[2] += a[3]
    two_after[4] += a[3] * 2
    two_after[5] += b[3] * 2
    body(a, b, one, two)
    np.testing.assert_allclose(one, one_after, rtol=4 * np.finfo(real).eps)
    np.testing.assert_allclose(two, two_after, rtol=4 * np.finfo(real).eps, atol=4 * np.finfo(real).eps)


@kernel
def asked_for(a, b, out):
    """Ask for records of one array and of two before one is read."""
    prefetch_each((a,), 3)
    prefetch_each((a, b), 4)
    store_wide(out, 0, load_wide(a, 3, load_each((a,), 3)))


@REALS
@pytest.mark.parametrize("body", [asked_for, getattr(asked_for, "py_func", asked_for)], ids=["compiled", "plain"])
def test_what_is_asked_for_is_hinted_and_changes_nothing(real, body, rng):
    a, b = (rng.normal(size=(5, 4)).astype(real) for _ in range(2))
    before, out = (a.copy(), b.copy()), np.zeros((1, 4), real)
    body(a, b, out)
    np.testing.assert_array_equal(out[0], a[3])
    np.testing.assert_array_equal((a, b), before)


@needs_jit
@REALS
def test_what_is_asked_for_is_in_the_code(real):
    """A lost hint would change no result, only how long it takes."""
    fresh = numba.njit(asked_for.py_func)  # of cached code there is nothing to read
    fresh(*(np.zeros((5, 4), real) for _ in range(3)))
    (code,) = fresh.inspect_llvm().values()
    assert code.count("call void @llvm.prefetch") >= 3


@kernel
def converted(a, out):
    """Write a lane value in another precision."""
    store_wide(out, 1, as_real(load_neighbours(a, 1), out))


@REALS
@pytest.mark.parametrize("other", [np.float64, np.float32])
@pytest.mark.parametrize("body", [converted, getattr(converted, "py_func", converted)], ids=["compiled", "plain"])
def test_precisions_are_converted(real, other, body, rng):
    width = lane_width(real)
    a, out = rng.normal(size=(8, 4)).astype(real), np.zeros((8, 4), other)
    body(a, out)
    np.testing.assert_array_equal(out.ravel()[width : 2 * width], a.ravel()[4 : 4 + width].astype(other))
    assert np.count_nonzero(out) == width


@REALS
def test_tables_begin_where_a_line_of_the_cache_does(real, rng):
    for shape in ((1,), (3, 5, lane_width(real))):
        empty = aligned(shape, real)
        assert (empty.shape, empty.dtype, empty.any()) == (shape, real, False)
        assert empty.ctypes.data % LINE == 0
    assert pack(rng.normal(size=(2, 4 * lane_width(real))), real).ctypes.data % LINE == 0


def test_a_lane_is_one_register():
    assert LANE_BYTES == 8 * lane_width(np.float64) == 4 * lane_width(np.float32)
    assert LANE_BYTES in (32, LINE)
    assert packed.lane_width is lane_width
