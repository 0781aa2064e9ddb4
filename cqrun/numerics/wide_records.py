"""Several records of four in one value: as many as fill a lane value, or the two records of a node.

load_records, load_neighbours, store_neighbours, load_pairs
                                    as many records as fill one lane value
filled, spread, sums                such lane values of one number, of an entry, of sums of entries
load_each, load_wide, store_wide    one record of each of several arrays as one value; such values in one array
prefetch_each                       a hint that such a record will be read soon
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic, overload

from cqrun.numerics.lanes import LANE_BYTES, Lanes, as_lanes, lane_width
from cqrun.numerics.packed import align
from cqrun.numerics.records import address_of, shuffle, whole_lane


def records_in_lane(a: np.ndarray) -> int:
    """Return the number of records of four in a lane value of an array's precision: 1, 2 or 4."""
    return LANE_BYTES // (4 * a.itemsize)


def load_neighbours(a: np.ndarray, n: int) -> Any:
    """Return records n, n + 1, ... of an (n, 4) array, as many as fit a lane value."""
    return a[n : n + records_in_lane(a)].reshape(-1)


def store_neighbours(a: np.ndarray, n: int, value: Any) -> None:
    """Write records n, n + 1, ... of an (n, 4) array."""
    a[n : n + records_in_lane(a)] = np.reshape(value, (-1, 4))


def load_records(a: np.ndarray, nodes: Any, offset: int) -> Any:
    """Return records nodes[0] + offset, nodes[1] + offset, ... of an (n, 4) array in one lane value."""
    return a[np.array(nodes) + offset].reshape(-1)


def load_pairs(a: np.ndarray, nodes: Any, offset: int) -> Any:
    """Return the first and the second records of pairs nodes[0] + offset, ... in an (m, 4) array of pairs."""
    pairs = a.reshape(-1, 2, 4)[np.array(nodes) + offset]
    return pairs[:, 0].reshape(-1), pairs[:, 1].reshape(-1)


def filled(number: float, like: np.ndarray) -> Any:
    """Return a lane value of one number in the precision of the array `like`."""
    return np.full(lane_width(like.dtype), number, like.dtype)


def spread(a: Any, k: int) -> Any:
    """Return each record's entry k in all four places of that record."""
    return np.repeat(a[k::4], 4)


def sums(a: Any, b: Any, c: Any) -> Any:
    """Return records of the sums (a, b, c, 0); the sum of a record is (entry 0 + entry 1) + (entry 2 + entry 3)."""
    out = np.zeros_like(a)
    for k, x in enumerate((a, b, c)):
        out[k::4] = (x[0::4] + x[1::4]) + (x[2::4] + x[3::4])
    return out


@intrinsic
def _load_neighbours(typingctx: Any, a: Any, n: Any) -> Any:
    lanes = whole_lane(a.dtype)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = context.get_value_type(lanes)
        return builder.load(address_of(context, builder, a, args[0], args[1], vector), align=align(a))

    return signature(lanes, a, types.intp), codegen


@intrinsic
def _store(typingctx: Any, a: Any, n: Any, value: Any) -> Any:
    """Write a value of any length from record n on."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = address_of(context, builder, a, args[0], args[1], args[2].type)
        builder.store(args[2], pointer, align=align(a))
        return context.get_dummy_value()

    return signature(types.none, a, types.intp, value), codegen


@intrinsic
def _load_records(typingctx: Any, a: Any, nodes: Any, offset: Any) -> Any:
    lanes, quad = whole_lane(a.dtype), Lanes(a.dtype, 4)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = context.get_value_type(quad)
        parts = []
        for k in range(len(nodes)):
            node = builder.add(builder.extract_value(args[1], k), args[2])
            parts.append(builder.load(address_of(context, builder, a, args[0], node, vector), align=align(a)))
        while len(parts) > 1:
            wide = list(range(2 * parts[0].type.count))
            parts = [shuffle(builder, parts[k], parts[k + 1], wide) for k in range(0, len(parts), 2)]
        return parts[0]

    return signature(lanes, a, nodes, types.intp), codegen


@intrinsic
def _load_pairs(typingctx: Any, a: Any, nodes: Any, offset: Any) -> Any:
    lanes, pair = whole_lane(a.dtype), Lanes(a.dtype, 8)
    result = types.UniTuple(lanes, 2)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = context.get_value_type(pair)
        parts = []
        for k in range(len(nodes)):
            node = builder.add(builder.extract_value(args[1], k), args[2])
            record = builder.mul(node, ir.Constant(node.type, 2))
            parts.append(builder.load(address_of(context, builder, a, args[0], record, vector), align=align(a)))
        while len(parts) > 2:
            wide = list(range(2 * parts[0].type.count))
            parts = [shuffle(builder, parts[k], parts[k + 1], wide) for k in range(0, len(parts), 2)]
        halves = [[8 * k + half + e for k in range(len(nodes)) for e in range(4)] for half in (0, 4)]
        first, last = parts[0], parts[-1]  # the same if a lane value holds one record
        return context.make_tuple(builder, result, [shuffle(builder, first, last, picks) for picks in halves])

    return signature(result, a, nodes, types.intp), codegen


@intrinsic
def _filled(typingctx: Any, number: Any, like: Any) -> Any:
    lanes = whole_lane(like.dtype)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return as_lanes(context, builder, args[0], number, lanes)

    return signature(lanes, number, like), codegen


@intrinsic(prefer_literal=True)
def _spread(typingctx: Any, a: Any, k: Any) -> Any:
    place = k.literal_value

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        picks = [lane // 4 * 4 + place for lane in range(a.width)]
        return shuffle(builder, args[0], ir.Constant(args[0].type, ir.Undefined), picks)

    return signature(a, a, k), codegen


@intrinsic
def _sums(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        undefined = ir.Constant(args[0].type, ir.Undefined)
        totals = []
        for x in args:
            for step in (1, 2):
                other = shuffle(builder, x, undefined, [lane ^ step for lane in range(a.width)])
                x = builder.fadd(x, other)
            totals.append(x)
        first = [lane + a.width * (lane % 4 % 2) for lane in range(a.width)]
        zero = ir.Constant(args[0].type, [0.0] * a.width)
        pairs = shuffle(builder, totals[0], totals[1], first), shuffle(builder, totals[2], zero, first)
        return shuffle(builder, *pairs, [lane + a.width * (lane % 4 // 2) for lane in range(a.width)])

    return signature(a, a, b, c), codegen


@overload(records_in_lane)
def _records_in_lane(a):
    count = whole_lane(a.dtype).width // 4
    return lambda a: count


@overload(load_neighbours)
def _load_neighbours_overload(a, n):
    return lambda a, n: _load_neighbours(a, n)


@overload(store_neighbours)
def _store_neighbours_overload(a, n, value):
    return lambda a, n, value: _store(a, n, value)


@overload(load_records)
def _load_records_overload(a, nodes, offset):
    return lambda a, nodes, offset: _load_records(a, nodes, offset)


@overload(load_pairs)
def _load_pairs_overload(a, nodes, offset):
    return lambda a, nodes, offset: _load_pairs(a, nodes, offset)


@overload(filled)
def _filled_overload(number, like):
    return lambda number, like: _filled(number, like)


@overload(spread, prefer_literal=True)
def _spread_overload(a, k):
    return lambda a, k: _spread(a, k)


@overload(sums)
def _sums_overload(a, b, c):
    return lambda a, b, c: _sums(a, b, c)


# --- one record of each of several arrays, as one value --------------------------------------------------------


def load_each(arrays: Any, n: int) -> Any:
    """Return record n of every array of a tuple of one or two, one after the other, as one value."""
    return np.concatenate([a[n] for a in arrays])


def prefetch_each(arrays: Any, n: int) -> None:
    """Prefetch record n of every array of a tuple into the cache; this changes no value."""


def load_wide(a: np.ndarray, n: int, like: Any) -> Any:
    """Return entry n of an (m, 4) array of values as long as `like`."""
    return a.reshape(-1, len(like))[n].copy()


def store_wide(a: np.ndarray, n: int, value: Any) -> None:
    """Write entry n of an (m, 4) array of values of this length."""
    a.reshape(-1, len(value))[n] = value


@intrinsic
def _load_each(typingctx: Any, arrays: Any, n: Any) -> Any:
    quad, wide = Lanes(arrays[0].dtype, 4), Lanes(arrays[0].dtype, 4 * len(arrays))

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = context.get_value_type(quad)
        parts = []
        for k, kind in enumerate(arrays):
            pointer = address_of(context, builder, kind, builder.extract_value(args[0], k), args[1], vector)
            parts.append(builder.load(pointer, align=align(kind)))
        return parts[0] if len(parts) == 1 else shuffle(builder, *parts, list(range(8)))

    return signature(wide, arrays, types.intp), codegen


@intrinsic
def _prefetch_each(typingctx: Any, arrays: Any, n: Any) -> Any:
    byte, number = ir.IntType(8), ir.IntType(32)
    to_read, to_keep, of_data = number(0), number(3), number(1)  # as LLVM's `prefetch` counts them

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        where = byte.as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [where, number, number, number])
        hint = builder.module.declare_intrinsic("llvm.prefetch", [where], kind)
        for k, array in enumerate(arrays):
            pointer = address_of(context, builder, array, builder.extract_value(args[0], k), args[1], byte)
            builder.call(hint, [pointer, to_read, to_keep, of_data])
        return context.get_dummy_value()

    return signature(types.none, arrays, types.intp), codegen


@intrinsic
def _load_wide(typingctx: Any, a: Any, n: Any, like: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = address_of(context, builder, a, args[0], args[1], args[2].type)
        return builder.load(pointer, align=align(a))

    return signature(like, a, types.intp, like), codegen


@overload(load_each)
def _load_each_overload(arrays, n):
    return lambda arrays, n: _load_each(arrays, n)


@overload(prefetch_each)
def _prefetch_each_overload(arrays, n):
    return lambda arrays, n: _prefetch_each(arrays, n)


@overload(load_wide)
def _load_wide_overload(a, n, like):
    per_entry = like.width // 4
    return lambda a, n, like: _load_wide(a, n * per_entry, like)


@overload(store_wide)
def _store_wide_overload(a, n, value):
    per_entry = value.width // 4
    return lambda a, n, value: _store(a, n * per_entry, value)
