"""Symmetric matrices as rows: D (D + 1) / 2 numbers, the diagonal first, then 01 (02 12); on numbers or lanes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import overload

from cqrun.plugin.contract import Array

_FROM = {
    3: lambda s: (s[0], s[2], s[2], s[1]),
    6: lambda s: (s[0], s[3], s[4], s[3], s[1], s[5], s[4], s[5], s[2]),
}
_TO = {
    4: lambda S: (S[0], S[3], S[1]),
    9: lambda S: (S[0], S[4], S[8], S[1], S[2], S[5]),
}
_TO_VJP = {
    4: lambda S_bar: (S_bar[0], S_bar[3], S_bar[1] * 2.0),
    9: lambda S_bar: (S_bar[0], S_bar[4], S_bar[8], S_bar[1] * 2.0, S_bar[2] * 2.0, S_bar[5] * 2.0),
}
_FROM_VJP = {
    3: lambda s_bar: (s_bar[0], s_bar[2] * 0.5, s_bar[2] * 0.5, s_bar[1]),
    6: lambda s_bar: (
        s_bar[0], s_bar[3] * 0.5, s_bar[4] * 0.5, s_bar[3] * 0.5, s_bar[1], s_bar[5] * 0.5, s_bar[4] * 0.5,
        s_bar[5] * 0.5, s_bar[2],
    ),
}  # fmt: skip


def symmetric_rows(S: Array) -> Array:
    """Return the rows (D (D + 1) / 2,) of a symmetric matrix (D, D)."""
    pairs = [(0, 1)] if len(S) == 2 else [(0, 1), (0, 2), (1, 2)]
    return np.array([*np.diag(S), *(S[i, j] for i, j in pairs)])


def from_rows(s: Any) -> Any:
    """Return the full symmetric matrix with these rows."""
    return _FROM[len(s)](s)


def to_rows(S: Any) -> Any:
    """Return the rows of a symmetric matrix."""
    return _TO[len(S)](S)


def to_rows_vjp(S_bar: Any) -> Any:
    """Return the cotangents of the rows for a symmetric S_bar: an off-diagonal row counts twice."""
    return _TO_VJP[len(S_bar)](S_bar)


def from_rows_vjp(s_bar: Any) -> Any:
    """Return the symmetric cotangent of a matrix whose rows have these: an off-diagonal row is in two entries."""
    return _FROM_VJP[len(s_bar)](s_bar)


@overload(from_rows)
def _from_rows(s):
    return _FROM[len(s)]


@overload(to_rows)
def _to_rows(S):
    return _TO[len(S)]


@overload(to_rows_vjp)
def _to_rows_vjp(S_bar):
    return _TO_VJP[len(S_bar)]


@overload(from_rows_vjp)
def _from_rows_vjp(s_bar):
    return _FROM_VJP[len(s_bar)]
