"""SIMD lanes: a lane value holds the numbers of a few neighbouring particles; plain operators work on it.

LLVM does not vectorise the engine's loops by itself, because it cannot rule out aliasing. So a kernel loads `width`
neighbouring particles as one value, and the small-tensor functions of `tensor.py` work on it unchanged. Without the JIT
a lane value is a NumPy array, and the functions below work on arrays.

    + - * / < > &                  on lanes, or on lanes and a number
    lane, with_lane, all_lanes     single entries; a whole comparison
    select, floor, sqrt, log ...   functions without an operator
    as_real                        another precision

A lane value has 64 bytes, 8 float64 or 16 float32, if the processor has the 32 registers of AVX-512; otherwise 32
bytes, because the 16 registers of AVX2 hold half as much. Lanes never mix, and sums over particles have a fixed number
of parts (engine/probe.py). The only floating-point freedom of the compiler is `contract` (fused multiply-add); `nnan`
and `ninf` would delete the checks for non-finite numbers. The compiler decides which of two products it fuses, so
results on another kind of processor differ in their last bits.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.registry import cpu_target
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, overload, register_model

from cqrun.numerics.compile import named

FLAGS = ("contract",)


def _lane_bytes() -> int:
    """Return the bytes of a lane value for the CPU features that Numba compiles for, which are in its cache's keys."""
    _, _, features = cpu_target.target_context.codegen().magic_tuple()
    return 64 if "+avx512f" in features.split(",") else 32


LANE_BYTES = _lane_bytes()


def lane_width(dtype: Any) -> int:
    """Return the number of entries of a lane value of `dtype`."""
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


def llvm_real(real: types.Float) -> ir.Type:
    return ir.DoubleType() if real.bitwidth == 64 else ir.FloatType()


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Lanes) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(llvm_real(fe_type.real), fe_type.width))


@register_model(Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Mask) -> None:
        super().__init__(dmm, fe_type, ir.VectorType(ir.IntType(1), fe_type.width))


# --- emitting LLVM --------------------------------------------------------------------------------


def index32(value: int) -> ir.Constant:
    return ir.Constant(ir.IntType(32), value)


def _splat(builder: Any, scalar: Any, vector: ir.VectorType) -> Any:
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, index32(0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), vector.count), [0] * vector.count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), mask)


def as_lanes(context: Any, builder: Any, value: Any, given: types.Type, lanes: Lanes) -> Any:
    """Turn a scalar into lanes in the precision of the other operand, so that nothing is promoted silently."""
    if isinstance(given, Lanes):
        return value
    scalar = context.cast(builder, value, given, lanes.real)
    return _splat(builder, scalar, context.get_value_type(lanes))


def _vector_call(builder: Any, name: str, vector: ir.VectorType, args: list[Any]) -> Any:
    """Call an LLVM intrinsic on vectors by its full name, because llvmlite does not build these names."""
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
    """Define the binary operator `op` on lanes, or on lanes and a number."""

    @infer_global(op)
    class _Typing(AbstractTemplate):
        def generic(self, args: tuple[types.Type, ...], kws: dict[str, Any]) -> Any:
            lanes = _lanes_of(args) if len(args) == 2 and not kws else None
            if lanes is None:
                return None
            return signature(Mask(lanes.width) if to_mask else lanes, *args)

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = _lanes_of(sig.args)
        a, b = (as_lanes(context, builder, v, t, lanes) for v, t in zip(args, sig.args, strict=True))
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


def _define_unary(ufunc: Callable[[Any], Any], name: str) -> Callable[[Any], Any]:
    """Return a function of one value: `llvm.<name>` on lanes, `ufunc` on numbers and without the JIT."""

    @intrinsic
    def on_lanes(typingctx: Any, a: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return _vector_call(builder, name, args[0].type, [args[0]])

        return signature(a, a), codegen

    def function(a: Any) -> Any:
        return ufunc(a)

    function.__name__ = name
    function.__doc__ = f"Return {name}(a), on lanes or on a number."

    @overload(function)
    def _(a):
        if isinstance(a, Lanes):
            return named(lambda a: on_lanes(a), f"{name}_lanes")
        return named(lambda a: ufunc(a), f"{name}_number") if isinstance(a, types.Number) else None

    return function


floor = _define_unary(np.floor, "floor")
sqrt = _define_unary(np.sqrt, "sqrt")
log = _define_unary(np.log, "log")
exp = _define_unary(np.exp, "exp")


def select(mask: Any, a: Any, b: Any) -> Any:
    """Return `a` where the mask is true and `b` elsewhere, lane by lane."""
    return np.where(mask, a, b)


@intrinsic
def _select_lanes(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    lanes = _lanes_of((a, b))
    if lanes is None:
        return None

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        x = as_lanes(context, builder, args[1], sig.args[1], lanes)
        y = as_lanes(context, builder, args[2], sig.args[2], lanes)
        return builder.select(args[0], x, y)

    return signature(lanes, mask, a, b), codegen


@overload(select)
def _select(mask, a, b):
    if isinstance(mask, Mask):
        return lambda mask, a, b: _select_lanes(mask, a, b)
    return lambda mask, a, b: a if mask else b


def below(a: Any, b: Any) -> Any:
    """Return whether a < b, lane by lane; of complex numbers without the JIT, the real parts count."""
    return np.real(a) < np.real(b)


@overload(below)
def _below(a, b):
    return lambda a, b: a < b


def all_lanes(mask: Any) -> bool:
    """Return whether the mask is true in every lane."""
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


def as_real(a: Any, like: np.ndarray) -> Any:
    """Return a lane value in the precision of the array `like`."""
    return a.astype(like.dtype)


@intrinsic
def _as_real(typingctx: Any, a: Any, like: Any) -> Any:
    lanes = Lanes(like.dtype, a.width)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector = context.get_value_type(lanes)
        if lanes.real.bitwidth == a.real.bitwidth:
            return args[0]
        return (builder.fpext if lanes.real.bitwidth > a.real.bitwidth else builder.fptrunc)(args[0], vector)

    return signature(lanes, a, like), codegen


@overload(as_real)
def _as_real_overload(a, like):
    return lambda a, like: _as_real(a, like)
