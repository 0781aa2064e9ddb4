"""Logarithm and exponential of lanes without a call for each entry, within two units of the last place.

The bits of a number are 2^e m. log m is a series in (m - 1) / (m + 1), and exp x = 2^n exp r one in r, with |r| < 0.35.
Numbers, and arrays without the JIT, take NumPy's functions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic, overload, register_jitable

from cqrun.numerics.compile import named
from cqrun.numerics.lanes import Lanes, floor, select

DIGITS, BIAS = {64: 52, 32: 23}, {64: 1023, 32: 127}
ROOT, LOG2_E = 1.4142135623730951, 1.4426950408889634
LN2_HIGH, LN2_LOW = 0.693145751953125, 1.4286068203094173e-06
"""log 2 in two parts; products of the first with an exponent are exact."""

LARGEST = {64: 709.0, 32: 88.0}
"""The exponential is finite up to here; beyond it and below its negative, it is infinite and zero."""


def logarithm(a: Any) -> Any:
    """Return log(a); NaN for a number that is not positive."""
    return np.log(a)


def exponential(a: Any) -> Any:
    """Return exp(a)."""
    return np.exp(a)


@overload(logarithm)
def _logarithm(a):
    if isinstance(a, Lanes):
        return named(lambda a: _log_lanes(a), "logarithm_lanes")
    return named(lambda a: np.log(a), "logarithm_number") if isinstance(a, types.Number) else None


@overload(exponential)
def _exponential(a):
    if isinstance(a, Lanes):
        return named(lambda a: _exp_lanes(a), "exponential_lanes")
    return named(lambda a: np.exp(a), "exponential_number") if isinstance(a, types.Number) else None


@register_jitable
def _log_lanes(a: Any) -> Any:
    m, e = _mantissa(a), _exponent(a)
    large = m > m * 0.0 + ROOT
    m, e = select(large, m * 0.5, m), select(large, e + 1.0, e)
    s = (m - 1.0) / (m + 1.0)
    q = s * s
    series = 1.0 / 23.0
    series = 1.0 / 21.0 + q * series
    series = 1.0 / 19.0 + q * series
    series = 1.0 / 17.0 + q * series
    series = 1.0 / 15.0 + q * series
    series = 1.0 / 13.0 + q * series
    series = 1.0 / 11.0 + q * series
    series = 1.0 / 9.0 + q * series
    series = 1.0 / 7.0 + q * series
    series = 1.0 / 5.0 + q * series
    series = 1.0 / 3.0 + q * series
    found = e * LN2_HIGH + (2.0 * s + (2.0 * s * q * series + e * LN2_LOW))
    return select(a > a * 0.0, found, a * 0.0 + np.nan)


@register_jitable
def _exp_lanes(a: Any) -> Any:
    limit = _largest(a)
    inside = select(a < limit, a, limit)
    inside = select(-limit < inside, inside, -limit)
    n = floor(inside * LOG2_E + 0.5)
    r = (inside - n * LN2_HIGH) - n * LN2_LOW
    series = 1.0 / 6227020800.0
    series = 1.0 / 479001600.0 + r * series
    series = 1.0 / 39916800.0 + r * series
    series = 1.0 / 3628800.0 + r * series
    series = 1.0 / 362880.0 + r * series
    series = 1.0 / 40320.0 + r * series
    series = 1.0 / 5040.0 + r * series
    series = 1.0 / 720.0 + r * series
    series = 1.0 / 120.0 + r * series
    series = 1.0 / 24.0 + r * series
    series = 1.0 / 6.0 + r * series
    found = (1.0 + (r + r * r * (0.5 + r * series))) * _power_of_two(n)
    one = found * 0.0 + 1.0
    found = select(limit < a, one * np.inf, found)
    found = select(a < -limit, one - 1.0, found)
    return select(a < one, found, select(a > one - 1.0, found, a))  # NaN is neither


# --- bits -------------------------------------------------------------------------------------------------------------


def _integers(vector: ir.VectorType, bits: int) -> ir.VectorType:
    return ir.VectorType(ir.IntType(bits), vector.count)


def _all(kind: ir.VectorType, value: int) -> ir.Constant:
    return ir.Constant(kind, [value] * kind.count)


@intrinsic
def _mantissa(typingctx: Any, a: Any) -> Any:
    """Return m in [1, 2) of a = 2^e m."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = a.real.bitwidth
        integers = _integers(args[0].type, bits)
        kept = builder.and_(builder.bitcast(args[0], integers), _all(integers, (1 << DIGITS[bits]) - 1))
        return builder.bitcast(builder.or_(kept, _all(integers, BIAS[bits] << DIGITS[bits])), args[0].type)

    return signature(a, a), codegen


@intrinsic
def _exponent(typingctx: Any, a: Any) -> Any:
    """Return e of a = 2^e m as a lane value: the digits of 2^digits + e + bias are the exponent's."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits, vector = a.real.bitwidth, args[0].type
        integers, digits = _integers(vector, bits), DIGITS[bits]
        shifted = builder.lshr(builder.bitcast(args[0], integers), _all(integers, digits))
        one = _all(integers, (BIAS[bits] + digits) << digits)  # 2^digits
        number = builder.bitcast(builder.or_(shifted, one), vector)
        return builder.fsub(number, ir.Constant(vector, [float(2**digits + BIAS[bits])] * vector.count))

    return signature(a, a), codegen


@intrinsic
def _power_of_two(typingctx: Any, n: Any) -> Any:
    """Return 2^n for whole numbers n in a lane value."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits, vector = n.real.bitwidth, args[0].type
        integers, digits = _integers(vector, bits), DIGITS[bits]
        number = builder.fadd(args[0], ir.Constant(vector, [float(2**digits + BIAS[bits])] * vector.count))
        return builder.bitcast(builder.shl(builder.bitcast(number, integers), _all(integers, digits)), vector)

    return signature(n, n), codegen


@intrinsic
def _largest(typingctx: Any, a: Any) -> Any:
    """Return the largest exponent of this precision as a lane value."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return ir.Constant(args[0].type, [LARGEST[a.real.bitwidth]] * args[0].type.count)

    return signature(a, a), codegen
