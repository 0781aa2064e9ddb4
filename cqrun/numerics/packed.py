"""Lanes in memory: packed tables of particles.

A (rows, n) table of particles is packed as (n / width, rows, width): the numbers of a lane of neighbours lie together,
so a pass reads one stream of memory instead of one per row. (Rows at equal distances compete for the same cache sets,
which is up to twice as slow.)

    pack, unpack                   convert between a (rows, n) table and its packed array
    aligned                        make an array of zeros
    load, store, accumulate        access the lane value of one row
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import signature
from numba.extending import intrinsic, overload

from cqrun.numerics.lanes import LANE_BYTES, Lanes, as_lanes, lane_width

LINE = 64
"""Bytes of a cache line; a lane value fits into one."""


def address(context: Any, builder: Any, array_type: Any, array: Any, offset: Any, vector: ir.Type) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [offset]), vector.as_pointer())


def align(array_type: Any) -> int:
    return array_type.dtype.bitwidth // 8


def aligned(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Return zeros that start at a cache line, so that no lane value lies in two lines."""
    need = prod(shape) * np.dtype(dtype).itemsize
    memory = np.zeros(need + LINE, np.uint8)
    begin = -memory.ctypes.data % LINE
    return memory[begin : begin + need].view(dtype).reshape(shape)


def pack(table: np.ndarray, dtype: Any) -> np.ndarray:
    """Return the packed (n / width, rows, width) array of a (rows, n) table; n is a multiple of the width."""
    width = lane_width(dtype)
    rows, n = table.shape
    out = aligned((n // width, rows, width), dtype)
    out[...] = table.reshape(rows, n // width, width).transpose(1, 0, 2)
    return out


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
    """Return the address of [i / width, row, 0], at entry i * rows + row * width."""
    array, row, i = args
    shape = cgutils.unpack_tuple(builder, context.make_array(array_type)(context, builder, array).shape)
    inside = builder.mul(row, ir.Constant(row.type, lanes.width))
    offset = builder.add(builder.mul(i, shape[1]), inside)
    return address(context, builder, array_type, array, offset, context.get_value_type(lanes))


@intrinsic
def _load(typingctx: Any, a: Any, row: Any, i: Any) -> Any:
    lanes = Lanes(a.dtype, LANE_BYTES * 8 // a.dtype.bitwidth)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_packed_pointer(context, builder, a, args, lanes), align=align(a))

    return signature(lanes, a, types.intp, types.intp), codegen


@intrinsic
def _store(typingctx: Any, a: Any, row: Any, i: Any, value: Any) -> Any:
    lanes = Lanes(a.dtype, LANE_BYTES * 8 // a.dtype.bitwidth)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = as_lanes(context, builder, args[3], value, lanes)
        builder.store(data, _packed_pointer(context, builder, a, args[:3], lanes), align=align(a))
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
