"""SIMD lanes: one value that holds a few neighbours, computed on by plain operators.

LLVM vectorises none of the engine's loops by itself (it cannot rule out aliasing), so a kernel loads
`width` neighbouring particles as one value, and the small-tensor functions of `tensor.py` run on it
unchanged. With the JIT off, a lane value is a NumPy array, and each function below is its own twin.

    load, store, accumulate        `width` neighbours in one row of a packed table of particles
    load4, store4, make4           the 4 components of a grid node: momentum (or velocity) and mass
    load_quads, store_quads        between lanes and 4-component records, n records at a time
    select, floor, sqrt, log ...   what operators cannot say

A float64 lane value has 8 entries and a float32 one 16: 64 bytes, one AVX-512 register. LLVM lowers it
to what the processor has (AVX-512, AVX2, NEON). `contract` (fused multiply-add) is the only
floating-point freedom given to the compiler: `nnan` and `ninf` would delete the non-finite guards.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, overload, register_model

LANE_BYTES = 64
FLAGS = ("contract",)
DEFAULT_MASK = types.boolean


def lane_width(dtype: Any) -> int:
    """Return how many numbers of `dtype` one lane value holds."""
    return LANE_BYTES // np.dtype(dtype).itemsize


class Lanes(types.Type):
    """Numba type of a lane value: `width` reals in one LLVM vector."""

    def __init__(self, real: types.Float, width: int) -> None:
        self.real, self.width = real, width
        super().__init__(f"Lanes({real}, {width})")


class Mask(types.Type):
    """Numba type of a comparison of lane values."""

    def __init__(self, width: int) -> None:
        self.width = width
        super().__init__(f"Mask({width})")


def _llvm_real(real: types.Float) -> ir.Type:
    return ir.DoubleType() if real.bitwidth == 64 else ir.FloatType()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Lanes) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(_llvm_real(fe_type.real), fe_type.width))


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Mask) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.IntType(1), fe_type.width))


# --- emitting LLVM --------------------------------------------------------------------------------


def _index(value: int) -> ir.Constant:
    return ir.Constant(ir.IntType(32), value)


def _splat(builder: Any, scalar: Any, vector: ir.VectorType) -> Any:
    one = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, _index(0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)
    return builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), mask)


def _as_lanes(context: Any, builder: Any, value: Any, given: types.Type, lanes: Lanes) -> Any:
    """Turn a scalar into lanes of the same precision as its partner: no silent promotion."""
    if isinstance(given, Lanes):
        return value
    scalar = context.cast(builder, value, given, lanes.real)
    return _splat(builder, scalar, context.get_value_type(lanes))


def _shuffle(builder: Any, a: Any, b: Any, picks: list[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(picks)), picks))


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, offset: Any, vector: ir.Type) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [offset]), vector.as_pointer())


def _align(array_type: Any) -> int:
    return array_type.dtype.bitwidth // 8


def _vector_call(builder: Any, name: str, vector: ir.VectorType, args: list[Any]) -> Any:
    """Call an LLVM intrinsic on vectors; llvmlite knows no names for these, so it is spelt out."""
    letter = "f64" if isinstance(vector.element, ir.DoubleType) else "f32"
    kind = ir.FunctionType(vector, [vector] * len(args))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{vector.count}{letter}")
    return builder.call(function, args)


# --- operators --------------------------------------------------------------------------------------


def _lanes_of(args: tuple[types.Type, ...]) -> Lanes | None:
    lanes = {a for a in args if isinstance(a, Lanes)}
    rest = [a for a in args if not isinstance(a, Lanes)]
    legal = len(lanes) == 1 and all(isinstance(a, types.Number) for a in rest)
    return lanes.pop() if legal else None


def _define_operator(op: Callable[..., Any], emit: Callable[..., Any], *, to_mask: bool = False) -> None:
    """Give Numba the binary operator `op` on lanes, or on lanes and a number."""

    @infer_global(op)
    class _Typing(AbstractTemplate):
        def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
            lanes = _lanes_of(args) if len(args) == 2 and not kws else None
            if lanes is None:
                return None
            return signature(Mask(lanes.width) if to_mask else lanes, *args)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = _lanes_of(sig.args)
        a, b = (_as_lanes(context, builder, v, t, lanes) for v, t in zip(args, sig.args, strict=True))
        return emit(builder, a, b)

    for pair in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
        lower_builtin(op, *pair)(lower)


_define_operator(operator.add, lambda b, x, y: b.fadd(x, y, flags=FLAGS))
_define_operator(operator.sub, lambda b, x, y: b.fsub(x, y, flags=FLAGS))
_define_operator(operator.mul, lambda b, x, y: b.fmul(x, y, flags=FLAGS))
_define_operator(operator.truediv, lambda b, x, y: b.fdiv(x, y, flags=FLAGS))
_define_operator(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), to_mask=True)
_define_operator(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), to_mask=True)


@infer_global(operator.neg)
class _NegTyping(AbstractTemplate):
    def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
        return signature(args[0], args[0]) if isinstance(args[0], Lanes) else None


@lower_builtin(operator.neg, Lanes)
def _lower_neg(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.fneg(args[0])


@infer_global(operator.and_)
class _AndTyping(AbstractTemplate):
    def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
        same = isinstance(args[0], Mask) and args[0] == args[1]
        return signature(args[0], *args) if same else None


@lower_builtin(operator.and_, Mask, Mask)
def _lower_and(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.and_(*args)


# --- functions ----------------------------------------------------------------------------------------


def _define_unary(twin: Callable[[Any], Any], name: str, scalar: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a function of one value: `llvm.<name>` on lanes, `scalar` on numbers, `twin` without the JIT."""

    @intrinsic
    def on_lanes(typingctx: Any, a: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return _vector_call(builder, name, args[0].type, [args[0]])

        return signature(a, a), codegen

    def function(a: Any) -> Any:
        return twin(a)

    function.__name__ = name
    function.__doc__ = f"Return {name}(a), on lanes or on a number."

    @overload(function)
    def _(a):
        if isinstance(a, Lanes):
            return lambda a: on_lanes(a)
        return lambda a: scalar(a) if isinstance(a, types.Number) else None

    return function


floor = _define_unary(np.floor, "floor", np.floor)
sqrt = _define_unary(np.sqrt, "sqrt", np.sqrt)
log = _define_unary(np.log, "log", np.log)
exp = _define_unary(np.exp, "exp", np.exp)


def select(mask: Any, a: Any, b: Any) -> Any:
    """Return `a` where the mask holds and `b` elsewhere, lane by lane."""
    return np.where(mask, a, b)


@intrinsic
def _select_lanes(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    lanes = _lanes_of((a, b))
    if lanes is None:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = _as_lanes(context, builder, args[1], sig.args[1], lanes)
        y = _as_lanes(context, builder, args[2], sig.args[2], lanes)
        return builder.select(args[0], x, y)

    return signature(lanes, mask, a, b), codegen


@overload(select)
def _select(mask, a, b):
    if isinstance(mask, Mask):
        return lambda mask, a, b: _select_lanes(mask, a, b)
    return lambda mask, a, b: a if mask else b


def all_lanes(mask: Any) -> bool:
    """Say whether the mask holds in every lane."""
    return bool(np.all(mask))


@intrinsic
def _all_mask(typingctx: Any, mask: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(mask.width))
        return builder.icmp_unsigned("==", bits, ir.Constant(ir.IntType(mask.width), -1))

    return signature(types.boolean, mask), codegen


@overload(all_lanes)
def _all_lanes(mask):
    if isinstance(mask, Mask):
        return lambda mask: _all_mask(mask)
    return lambda mask: mask


def lane(a: Any, k: int) -> Any:
    """Return entry `k` of a lane value."""
    return a[k] if np.ndim(a) else a


@intrinsic
def _lane(typingctx: Any, a: Any, k: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.extract_element(args[0], args[1])

    return signature(a.real, a, k), codegen


@overload(lane)
def _lane_overload(a, k):
    if isinstance(a, Lanes):
        return lambda a, k: _lane(a, k)
    return lambda a, k: a


def with_lane(a: Any, k: int, value: Any) -> Any:
    """Return `a` with entry `k` replaced."""
    out = np.array(a)
    out[k] = value
    return out


@intrinsic
def _with_lane(typingctx: Any, a: Any, k: Any, value: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        scalar = context.cast(builder, args[2], sig.args[2], a.real)
        return builder.insert_element(args[0], scalar, args[1])

    return signature(a, a, k, value), codegen


@overload(with_lane)
def _with_lane_overload(a, k, value):
    if isinstance(a, Lanes):
        return lambda a, k, value: _with_lane(a, k, value)
    return lambda a, k, value: value


# --- memory: lanes of a packed array ----------------------------------------------------------------------
#
# A (rows, n) table of particles is packed as (n / width, rows, width): all numbers of a lane of neighbours lie
# together, so a pass reads one stream of memory, not one a row (rows at equal distance fight for the same
# cache sets: twice slower).


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
        data = _as_lanes(context, builder, args[3], value, lanes)
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
            vector = builder.insert_element(vector, scalar, _index(k))
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
        data = _as_lanes(context, builder, args[2], value, quad)
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
        columns = [
            _as_lanes(context, builder, v, t, lanes) for v, t in zip(args[2:], sig.args[2:], strict=True)
        ]
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
        vector = ir.VectorType(_llvm_real(a.dtype), 4 * width)
        offset = builder.mul(args[1], ir.Constant(args[1].type, 4))
        records = builder.load(_pointer(context, builder, a, args[0], offset, vector), align=_align(a))
        undefined = ir.Constant(vector, ir.Undefined)
        columns = [_shuffle(builder, records, undefined, [4 * p + k for p in range(width)]) for k in range(4)]
        return context.make_tuple(builder, result, columns)

    return signature(result, a, types.intp), codegen


@overload(load_quads)
def _load_quads_overload(a, i):
    return lambda a, i: _load_quads(a, i)
