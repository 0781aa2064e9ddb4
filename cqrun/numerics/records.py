"""Records of four numbers (a, b, c, d): a grid node, or a particle's vector, in an (n, 4) array.

make4, load4, store4           one record
load_quads, store_quads        one record for each entry of a lane, from and to four lane values

`wide_records.py` has several records in one value.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic, overload

from cqrun.numerics.lanes import LANE_BYTES, Lanes, as_lanes, index32, lane_width, llvm_real
from cqrun.numerics.packed import address, align


def shuffle(builder: Any, a: Any, b: Any, picks: list[int]) -> Any:
    """Return the entries `picks` of two vectors, one after the other."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(picks)), picks))


def address_of(context: Any, builder: Any, array_type: Any, array: Any, n: Any, vector: ir.Type) -> Any:
    """Return the address of record n as that of a vector."""
    return address(context, builder, array_type, array, builder.mul(n, ir.Constant(n.type, 4)), vector)


def whole_lane(real: types.Float) -> Lanes:
    """Return the type of a full lane value."""
    return Lanes(real, LANE_BYTES * 8 // real.bitwidth)


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
        vector = context.get_value_type(quad)
        return builder.load(address_of(context, builder, a, args[0], args[1], vector), align=align(a))

    return signature(quad, a, types.intp), codegen


@overload(load4)
def _load4_overload(a, n):
    return lambda a, n: _load4(a, n)


def store4(a: np.ndarray, n: int, value: Any) -> None:
    """Write record n of an (n, 4) array; a number is written to all four entries."""
    a[n] = value


@intrinsic
def _store4(typingctx: Any, a: Any, n: Any, value: Any) -> Any:
    quad = Lanes(a.dtype, 4)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = as_lanes(context, builder, args[2], value, quad)
        pointer = address_of(context, builder, a, args[0], args[1], context.get_value_type(quad))
        builder.store(data, pointer, align=align(a))
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
    lanes = whole_lane(a.dtype)
    width = lanes.width

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        columns = [as_lanes(context, builder, v, t, lanes) for v, t in zip(args[2:], sig.args[2:], strict=True)]
        pairs = [shuffle(builder, columns[k], columns[k + 1], list(range(2 * width))) for k in (0, 2)]
        picks = [k * width + p for p in range(width) for k in range(4)]
        records = shuffle(builder, pairs[0], pairs[1], picks)
        builder.store(records, address_of(context, builder, a, args[0], args[1], records.type), align=align(a))
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
    lanes = whole_lane(a.dtype)
    width = lanes.width
    result = types.UniTuple(lanes, 4)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = ir.VectorType(llvm_real(a.dtype), 4 * width)
        records = builder.load(address_of(context, builder, a, args[0], args[1], vector), align=align(a))
        undefined = ir.Constant(vector, ir.Undefined)
        columns = [shuffle(builder, records, undefined, [4 * p + k for p in range(width)]) for k in range(4)]
        return context.make_tuple(builder, result, columns)

    return signature(result, a, types.intp), codegen


@overload(load_quads)
def _load_quads_overload(a, i):
    return lambda a, i: _load_quads(a, i)
