"""Lanes in memory: packed tables of particles, and records of four.

A (rows, n) table of particles is packed as (n / width, rows, width): all numbers of a lane of neighbours lie
together, so a pass reads one stream of memory, not one a row (rows at equal distance fight for the same cache
sets: up to twice slower).

    pack, unpack                   between a (rows, n) table and its packed array
    load, store, accumulate        the lane value of one row
    make4, load4, store4           a record (a, b, c, d): a grid node, or a particle's vector
    load_quads, store_quads        as many records as a lane is wide, from and to four lane values
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import signature
from numba.extending import intrinsic, overload

from cqrun.lanes import LANE_BYTES, Lanes, as_lanes, index32, lane_width, llvm_real


def _shuffle(builder: Any, a: Any, b: Any, picks: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(picks)), picks))


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any, vector: ir.Type) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [offset]), vector.as_pointer())


def _align(array_type: Any) -> int:
    return array_type.dtype.bitwidth // 8


def pack(table: np.ndarray, dtype: Any) -> np.ndarray:
    """Return the packed (n / width, rows, width) array of a (rows, n) table; n is a multiple of the width."""
    width = lane_width(dtype)
    rows, n = table.shape
    return np.ascontiguousarray(table.reshape(rows, n // width, width).transpose(1, 0, 2), dtype=dtype)


def unpack(packed: np.ndarray) -> np.ndarray:
    """Return the (rows, n) float64 table of a packed array."""
    chunks, rows, width = packed.shape
    return packed.transpose(1, 0, 2).reshape(rows, chunks * width).astype(np.float64)


def load(a: np.ndarray, row: int, i: int) -> Any:
    """Return the lane value of `row` for particles i .. i + width; i is a multiple of the width."""
    return a[i // a.shape[2], row].copy()


def store(a: np.ndarray, row: int, i: int, value: Any) -> None:
    """Write a lane value, or one number to all its entries."""
    a[i // a.shape[2], row] = value


def accumulate(a: np.ndarray, row: int, i: int, value: Any) -> None:
    """Add a lane value."""
    a[i // a.shape[2], row] += value


def _packed_pointer(context: Any, builder: Any, array_type: Any, args: Any, lanes: Lanes) -> Any:
    """Return the address of [i / width, row, 0]: (i * rows + row * width) entries on."""
    array, row, i = args
    shape = cgutils.unpack_tuple(builder, context.make_array(array_type)(context, builder, array).shape)
    inside = builder.mul(row, ir.Constant(row.type, lanes.width))
    offset = builder.add(builder.mul(i, shape[1]), inside)
    return _pointer(context, builder, array_type, array, offset, context.get_value_type(lanes))


@intrinsic
def _load(typingctx: Any, a: Any, row: Any, i: Any) -> Any:
    lanes = Lanes(a.dtype, LANE_BYTES * 8 // a.dtype.bitwidth)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_packed_pointer(context, builder, a, args, lanes), align=_align(a))

    return signature(lanes, a, types.intp, types.intp), codegen


@intrinsic
def _store(typingctx: Any, a: Any, row: Any, i: Any, value: Any) -> Any:
    lanes = Lanes(a.dtype, LANE_BYTES * 8 // a.dtype.bitwidth)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = as_lanes(context, builder, args[3], value, lanes)
        builder.store(data, _packed_pointer(context, builder, a, args[:3], lanes), align=_align(a))
        return context.get_dummy_value()

    return signature(types.none, a, types.intp, types.intp, value), codegen


@overload(load)
def _load_overload(a, row, i):
    return lambda a, row, i: _load(a, row, i)


@overload(store)
def _store_overload(a, row, i, value):
    return lambda a, row, i, value: _store(a, row, i, value)


@overload(accumulate)
def _accumulate_overload(a, row, i, value):
    return lambda a, row, i, value: _store(a, row, i, _load(a, row, i) + value)


# --- memory: records of 4 --------------------------------------------------------------------------------


def make4(a: Any, b: Any, c: Any, d: Any, like: np.ndarray) -> Any:
    """Return the record (a, b, c, d) in the precision of the array `like`."""
    return np.array([a, b, c, d], dtype=like.dtype)


@intrinsic
def _make4(typingctx: Any, a: Any, b: Any, c: Any, d: Any, like: Any) -> Any:
    quad = Lanes(like.dtype, 4)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = ir.Constant(context.get_value_type(quad), ir.Undefined)
        for k in range(4):
            scalar = context.cast(builder, args[k], sig.args[k], quad.real)
            vector = builder.insert_element(vector, scalar, index32(k))
        return vector

    return signature(quad, a, b, c, d, like), codegen


@overload(make4)
def _make4_overload(a, b, c, d, like):
    return lambda a, b, c, d, like: _make4(a, b, c, d, like)


def load4(a: np.ndarray, n: int) -> Any:
    """Return record n of an (n, 4) array."""
    return a[n].copy()


@intrinsic
def _load4(typingctx: Any, a: Any, n: Any) -> Any:
    quad = Lanes(a.dtype, 4)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        offset = builder.mul(args[1], ir.Constant(args[1].type, 4))
        vector = context.get_value_type(quad)
        return builder.load(_pointer(context, builder, a, args[0], offset, vector), align=_align(a))

    return signature(quad, a, types.intp), codegen


@overload(load4)
def _load4_overload(a, n):
    return lambda a, n: _load4(a, n)


def store4(a: np.ndarray, n: int, value: Any) -> None:
    """Write record n of an (n, 4) array; a number goes to all four."""
    a[n] = value


@intrinsic
def _store4(typingctx: Any, a: Any, n: Any, value: Any) -> Any:
    quad = Lanes(a.dtype, 4)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = as_lanes(context, builder, args[2], value, quad)
        offset = builder.mul(args[1], ir.Constant(args[1].type, 4))
        pointer = _pointer(context, builder, a, args[0], offset, context.get_value_type(quad))
        builder.store(data, pointer, align=_align(a))
        return context.get_dummy_value()

    return signature(types.none, a, types.intp, value), codegen


@overload(store4)
def _store4_overload(a, n, value):
    return lambda a, n, value: _store4(a, n, value)


def store_quads(a: np.ndarray, i: int, x: Any, y: Any, z: Any, w: Any) -> None:
    """Write records i .. i + width of an (n, 4) array from four lane values (a transpose)."""
    rows = slice(i, i + lane_width(a.dtype))
    a[rows, 0], a[rows, 1], a[rows, 2], a[rows, 3] = x, y, z, w


@intrinsic
def _store_quads(typingctx: Any, a: Any, i: Any, x: Any, y: Any, z: Any, w: Any) -> Any:
    width = LANE_BYTES * 8 // a.dtype.bitwidth
    lanes = Lanes(a.dtype, width)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        columns = [as_lanes(context, builder, v, t, lanes) for v, t in zip(args[2:], sig.args[2:], strict=True)]
        pairs = [_shuffle(builder, columns[k], columns[k + 1], list(range(2 * width))) for k in (0, 2)]
        picks = [k * width + p for p in range(width) for k in range(4)]
        records = _shuffle(builder, pairs[0], pairs[1], picks)
        offset = builder.mul(args[1], ir.Constant(args[1].type, 4))
        builder.store(records, _pointer(context, builder, a, args[0], offset, records.type), align=_align(a))
        return context.get_dummy_value()

    return signature(types.none, a, types.intp, x, y, z, w), codegen


@overload(store_quads)
def _store_quads_overload(a, i, x, y, z, w):
    return lambda a, i, x, y, z, w: _store_quads(a, i, x, y, z, w)


def load_quads(a: np.ndarray, i: int) -> tuple[Any, Any, Any, Any]:
    """Return four lane values, the components of records i .. i + width of an (n, 4) array."""
    rows = a[i : i + lane_width(a.dtype)]
    return rows[:, 0].copy(), rows[:, 1].copy(), rows[:, 2].copy(), rows[:, 3].copy()


@intrinsic
def _load_quads(typingctx: Any, a: Any, i: Any) -> Any:
    width = LANE_BYTES * 8 // a.dtype.bitwidth
    lanes = Lanes(a.dtype, width)
    result = types.UniTuple(lanes, 4)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = ir.VectorType(llvm_real(a.dtype), 4 * width)
        offset = builder.mul(args[1], ir.Constant(args[1].type, 4))
        records = builder.load(_pointer(context, builder, a, args[0], offset, vector), align=_align(a))
        undefined = ir.Constant(vector, ir.Undefined)
        columns = [_shuffle(builder, records, undefined, [4 * p + k for p in range(width)]) for k in range(4)]
        return context.make_tuple(builder, result, columns)

    return signature(result, a, types.intp), codegen


@overload(load_quads)
def _load_quads_overload(a, i):
    return lambda a, i: _load_quads(a, i)
