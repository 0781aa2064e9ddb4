"""The rotation R of the polar decomposition F = R S, and its adjoint, on numbers or lanes.

R is the rotation nearest to F: it maximises tr(R^T F) over det R = 1, also for det F < 0 (the smallest singular value
is then negative: "signed singular values"). 2D has a closed form. 3D runs Newton's iteration R <- (R + R^-T) / 2
(Higham, Computing the polar decomposition, SIAM J. Sci. Stat. Comput. 1986) to convergence. If that would end at a
reflection, if det F is rounding error, or if it has not converged after 10 steps, R is computed from a 4 x 4
eigenproblem.

Derivative: dR = R [w]x with (tr(S) I - S) w = axial(R^T dF), so the denominators are s_i + s_j. It is smooth at F = I
and at equal singular values, and singular only if two signed singular values cancel.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import types
from numba.extending import overload, register_jitable

from cqrun.numerics.compile import allocating_kernel
from cqrun.numerics.lanes import Lanes, all_lanes, below, lane, select, sqrt, with_lane
from cqrun.numerics.tensor import (
    add,
    cofactor,
    det,
    inner,
    matvec,
    mul,
    mul_at,
    plus_diagonal,
    scale,
    sub,
    trace,
)

NEWTON_STEPS = 10
TINY = 1e-12
"""Lower limit of the denominators: if two signed singular values cancel, the derivative is unbounded."""


def polar(F: Any) -> Any:
    """Return R of the polar decomposition of F, a tuple of D * D."""
    return _polar_2d(F) if len(F) == 4 else _polar_3d(F)


def polar_vjp(F: Any, R: Any, R_bar: Any) -> Any:
    """Return the cotangent of F for R = polar(F) and the cotangent of R."""
    return _polar_2d_vjp(F, R, R_bar) if len(F) == 4 else _polar_3d_vjp(F, R, R_bar)


@overload(polar)
def _polar(F):
    return (lambda F: _polar_2d(F)) if len(F) == 4 else (lambda F: _polar_3d(F))


@overload(polar_vjp)
def _polar_vjp(F, R, R_bar):
    if len(F) == 4:
        return lambda F, R, R_bar: _polar_2d_vjp(F, R, R_bar)
    return lambda F, R, R_bar: _polar_3d_vjp(F, R, R_bar)


def away_from_zero(a: Any) -> Any:
    """Return `a`, or TINY if |a| is smaller."""
    return select(below(a * a, TINY * TINY), TINY, a)


@overload(away_from_zero)
def _away_from_zero(a):
    return lambda a: select(below(a * a, TINY * TINY), a * 0.0 + TINY, a)


@register_jitable
def _polar_2d(F: Any) -> Any:
    # tr(R^T F) is largest at the angle atan2(F10 - F01, F00 + F11)
    a, b = F[0] + F[3], F[2] - F[1]
    r = sqrt(a * a + b * b)
    turned = below(r * 0.0 + TINY, r)
    c = select(turned, a / away_from_zero(r), a * 0.0 + 1.0)
    s = select(turned, b / away_from_zero(r), b * 0.0)
    return (c, -s, s, c)


@register_jitable
def _polar_2d_vjp(F: Any, R: Any, R_bar: Any) -> Any:
    # dR = (dR/dangle) dangle, and dangle = (dR/dangle : dF) / (s_1 + s_2)
    turn = (-R[2], -R[0], R[0], -R[2])
    r = inner(R, F)
    return scale(turn, inner(R_bar, turn) / away_from_zero(r))


def _of_precision(a: Any, double: float, single: float) -> float:
    """Return one of two constants, by the precision of a number or of lanes."""
    return double if np.asarray(a).dtype.itemsize >= 8 else single


@overload(_of_precision)
def _of_precision_overload(a, double, single):
    real = a.real if isinstance(a, Lanes) else a
    if real == types.float64:
        return lambda a, double, single: double
    return lambda a, double, single: single


@register_jitable
def _polar_3d(F: Any) -> Any:
    # Newton converges quadratically, so a last step below the root of the rounding error is enough
    converged = _of_precision(F[0], 1e-16, 1e-8)
    # a determinant below this part of |F|^3 is rounding error, as for a matrix of rank 1: Newton is useless there
    rounding = _of_precision(F[0], 1e-15, 5e-7)
    J = det(F)
    R = F
    small = below(J, J)
    for _ in range(NEWTON_STEPS):
        following = scale(add(R, scale(cofactor(R), 1.0 / det(R))), 0.5)
        step = sub(following, R)
        R = following
        small = below(inner(step, step), J * 0.0 + converged)
        if all_lanes(small):
            break
    size = inner(F, F)
    proper = small & below(rounding * (size * sqrt(size)), J)
    return R if all_lanes(proper) else _mend(F, R, proper)


def _mend(F: Any, R: Any, proper: Any) -> Any:
    """Replace R by the nearest proper rotation in the lanes in which it is not proper."""
    F, R = [np.asarray(a) for a in F], [np.array(a) for a in R]
    for k in np.flatnonzero(~np.atleast_1d(proper)):
        rotation = nearest_rotation(tuple(a.reshape(-1)[k] for a in F))
        for a, value in zip(R, rotation, strict=True):
            a.reshape(-1)[k] = value
    return tuple(R)


@overload(_mend)
def _mend_overload(F, R, proper):
    if not isinstance(F[0], Lanes):
        return lambda F, R, proper: nearest_rotation(F)
    width = F[0].width

    def mend(F, R, proper):
        bad = select(proper, F[0] * 0.0, F[0] * 0.0 + 1.0)
        for k in range(width):
            if lane(bad, k) > 0.5:
                R = _put(R, k, nearest_rotation(_pick(F, k)))
        return R

    return mend


@register_jitable
def _pick(a: Any, k: int) -> Any:
    return (
        lane(a[0], k), lane(a[1], k), lane(a[2], k),
        lane(a[3], k), lane(a[4], k), lane(a[5], k),
        lane(a[6], k), lane(a[7], k), lane(a[8], k),
    )  # fmt: skip


@register_jitable
def _put(a: Any, k: int, b: Any) -> Any:
    return (
        with_lane(a[0], k, b[0]), with_lane(a[1], k, b[1]), with_lane(a[2], k, b[2]),
        with_lane(a[3], k, b[3]), with_lane(a[4], k, b[4]), with_lane(a[5], k, b[5]),
        with_lane(a[6], k, b[6]), with_lane(a[7], k, b[7]), with_lane(a[8], k, b[8]),
    )  # fmt: skip


@allocating_kernel
def nearest_rotation(F: Any) -> Any:
    """Return the rotation nearest to a 3D matrix of numbers with a determinant of any sign.

    It is the unit quaternion of the largest eigenvalue of a symmetric 4 x 4 matrix (Horn, Closed-form solution of
    absolute orientation using unit quaternions, J. Opt. Soc. Am. A 1987). A matrix that is not finite is returned
    unchanged; the rollout reports it.
    """
    if not np.isfinite(F[0] + F[1] + F[2] + F[3] + F[4] + F[5] + F[6] + F[7] + F[8]):
        return F
    K = np.empty((4, 4))
    tr = F[0] + F[4] + F[8]
    K[0, 0], K[1, 1], K[2, 2], K[3, 3] = tr, 2.0 * F[0] - tr, 2.0 * F[4] - tr, 2.0 * F[8] - tr
    K[1, 0], K[2, 0], K[3, 0] = F[7] - F[5], F[2] - F[6], F[3] - F[1]
    K[2, 1], K[3, 1], K[3, 2] = F[1] + F[3], F[2] + F[6], F[5] + F[7]
    K[0, 1], K[0, 2], K[0, 3] = K[1, 0], K[2, 0], K[3, 0]
    K[1, 2], K[1, 3], K[2, 3] = K[2, 1], K[3, 1], K[3, 2]
    vectors = np.linalg.eigh(K)[1]
    w, x, y, z = vectors[0, 3], vectors[1, 3], vectors[2, 3], vectors[3, 3]
    return (
        w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z,
    )  # fmt: skip


@register_jitable
def _polar_3d_vjp(F: Any, R: Any, R_bar: Any) -> Any:
    S = mul_at(R, F)
    M = plus_diagonal(scale(S, -1.0), trace(S))
    Y = mul_at(R, R_bar)
    y = (Y[7] - Y[5], Y[2] - Y[6], Y[3] - Y[1])
    # M is symmetric, so its inverse is its cofactor matrix over det M = (s1+s2)(s2+s3)(s3+s1)
    u = scale(matvec(cofactor(M), y), 1.0 / away_from_zero(det(M)))
    zero = y[0] * 0.0
    return mul(R, (zero, -u[2], u[1], u[2], zero, -u[0], -u[1], u[0], zero))
