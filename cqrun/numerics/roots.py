"""The inverse cube root, on numbers or lanes; with it J^(-2/3) costs a dozen products, and no call for each lane."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic, overload, register_jitable

from cqrun.numerics.compile import named
from cqrun.numerics.lanes import Lanes, select

MAGIC = {64: 0x553EF0FF, 32: 0x54A2FA8C}
"""Upper 32 bits of a number whose exponent is 4/3 of the bias, less what halves the largest error of the guess."""


def inverse_cube_root(a: Any) -> Any:
    """Return a^(-1/3); NaN for a number that is not positive."""
    if np.iscomplexobj(a):
        return np.where(np.real(a) > 0.0, np.asarray(a) ** (-1.0 / 3.0), np.nan)
    positive = np.asarray(a) > 0.0
    return np.where(positive, 1.0 / np.cbrt(np.where(positive, a, 1.0)), np.nan)


@overload(inverse_cube_root)
def _inverse_cube_root(a):
    if isinstance(a, Lanes):
        return named(lambda a: _on_lanes(a), "inverse_cube_root_lanes")
    if isinstance(a, types.Number):
        return named(lambda a: a ** (-1.0 / 3.0) if a > 0.0 else np.nan, "inverse_cube_root_number")
    return None


@register_jitable
def _on_lanes(a: Any) -> Any:
    """Improve a guess with the series of (1 - h)^(-1/3), h = 1 - a r^3, twice: from 3 % to 1e-5 and to rounding."""
    r = _guess(a)
    for _ in range(2):
        h = 1.0 - a * (r * r * r)
        r = r + r * h * (1.0 / 3.0 + h * (2.0 / 9.0 + h * (14.0 / 81.0)))
    return select(a > a * 0.0, r, a * 0.0 + np.nan)


@intrinsic
def _guess(typingctx: Any, a: Any) -> Any:
    """Return about a^(-1/3): in the bits of a number, the exponent and digits are nearly its logarithm."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vector, bits = args[0].type, a.real.bitwidth
        n, per = vector.count, bits // 32
        word = ir.IntType(32)
        words, upper = ir.VectorType(word, n * per), ir.VectorType(word, n)
        given = builder.bitcast(args[0], words)
        empty = ir.Constant(words, ir.Undefined)
        if per == 2:
            given = builder.shuffle_vector(given, empty, ir.Constant(upper, [2 * k + 1 for k in range(n)]))
        third = builder.udiv(given, ir.Constant(upper, [3] * n))
        found = builder.sub(ir.Constant(upper, [MAGIC[bits]] * n), third)
        if per == 2:  # the lower words are zero
            places = [k // 2 + (0 if k % 2 else n) for k in range(2 * n)]
            found = builder.shuffle_vector(found, ir.Constant(upper, [0] * n), ir.Constant(words, places))
        return builder.bitcast(found, vector)

    return signature(a, a), codegen
