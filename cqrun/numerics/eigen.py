"""Eigenvalues and eigenvectors of a symmetric matrix, in lanes: A = Q diag(a) Q^T, in a fixed number of operations.

2D has a closed form. In 3D the eigenvalue that lies farthest from the two others is a root of the characteristic cubic
that is never multiple. With A' = A - tr(A)/3 I, j = |A'|^2 / 2 and cos 3t = 3/2 sqrt(3) det(A') j^(-3/2), whose sign is
taken out,

    4 x^3 - 3 x = cos 3t >= 0,   x in [sqrt(3)/2, 1],   a = 2 sqrt(j/3) x.

Three Newton steps from a line are exact there. Its eigenvector is the longest cross product of two rows of A' - a I.
The other two are those of a 2 x 2 matrix in the plane across it. So nearly equal eigenvalues cost no digits
(Scherzinger and Dohrmann, Comput. Methods Appl. Mech. Eng. 197, 2008, who use the arc cosine).
"""

from __future__ import annotations

from typing import Any

from numba.extending import overload, register_jitable

from cqrun.numerics.lanes import below, select, sqrt
from cqrun.numerics.tensor import det, inner, plus_diagonal, scale, trace

TINY = 1e-30
"""Added to squares before a division: a matrix that is a multiple of I has any eigenvectors."""


def eigen(A: Any) -> Any:
    """Return the eigenvalues as a tuple of D, and Q as a tuple of D * D whose columns are the eigenvectors."""
    return _eigen_2d(A) if len(A) == 4 else _eigen_3d(A)


@overload(eigen)
def _eigen(A):
    return (lambda A: _eigen_2d(A)) if len(A) == 4 else (lambda A: _eigen_3d(A))


@register_jitable
def _eigen_2d(A: Any) -> Any:
    values, c, s = _of_two(A[0], A[1], A[3])
    return values, (c, -s, s, c)


@register_jitable
def _of_two(a: Any, b: Any, d: Any) -> Any:
    """Return the eigenvalues of [[a, b], [b, d]], and the cosine and sine of the first one's direction."""
    mean, half = 0.5 * (a + d), 0.5 * (a - d)
    r = sqrt(half * half + b * b)
    any_way = below(r, r * 0.0 + TINY)
    over = 1.0 / select(any_way, r * 0.0 + 1.0, r)
    double_cosine, double_sine = select(any_way, r * 0.0 + 1.0, half * over), select(any_way, r * 0.0, b * over)
    first = below(double_cosine * 0.0, double_cosine)
    larger = sqrt(0.5 + 0.5 * select(first, double_cosine, -double_cosine))
    smaller = 0.5 * double_sine / larger
    return (mean + r, mean - r), select(first, larger, smaller), select(first, smaller, larger)


@register_jitable
def _cross(u: Any, v: Any) -> Any:
    return (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])


@register_jitable
def _longer(u: Any, v: Any) -> Any:
    """Return the longer one of two vectors."""
    is_u = below(v[0] * v[0] + v[1] * v[1] + v[2] * v[2], u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    return (select(is_u, u[0], v[0]), select(is_u, u[1], v[1]), select(is_u, u[2], v[2]))


@register_jitable
def _unit(u: Any) -> Any:
    """Return a vector of length 1, the first axis for one without length."""
    square = u[0] * u[0] + u[1] * u[1] + u[2] * u[2]
    none = below(square, square * 0.0 + TINY)
    over = 1.0 / sqrt(select(none, square * 0.0 + 1.0, square))
    return (select(none, square * 0.0 + 1.0, u[0] * over), u[1] * over, u[2] * over)


@register_jitable
def _form(A: Any, u: Any, v: Any) -> Any:
    """Return u . A v."""
    return (
        u[0] * (A[0] * v[0] + A[1] * v[1] + A[2] * v[2])
        + u[1] * (A[3] * v[0] + A[4] * v[1] + A[5] * v[2])
        + u[2] * (A[6] * v[0] + A[7] * v[1] + A[8] * v[2])
    )


@register_jitable
def _eigen_3d(A: Any) -> Any:
    mean = trace(A) * (1.0 / 3.0)
    rest = plus_diagonal(A, -mean)
    square = 0.5 * inner(rest, rest)
    size = sqrt(square + TINY)
    part = scale(rest, 1.0 / size)  # its |A'|^2 is 2
    cosine = 2.598076211353316 * det(part)
    sign = select(below(cosine, cosine * 0.0), cosine * 0.0 - 1.0, cosine * 0.0 + 1.0)
    cosine = cosine * sign
    x = 0.866025403784438647 + 0.133974596215561353 * cosine
    for _ in range(3):
        x = x - (x * (4.0 * x * x - 3.0) - cosine) / (12.0 * x * x - 3.0)
    apart = 1.1547005383792517 * sign * x
    M = plus_diagonal(part, -apart)
    rows = (M[0], M[1], M[2]), (M[3], M[4], M[5]), (M[6], M[7], M[8])
    n = _unit(_longer(_longer(_cross(rows[0], rows[1]), _cross(rows[1], rows[2])), _cross(rows[2], rows[0])))
    # two axes across n: the one of the world that is least along it gives a good cross product
    side = below(n[0] * n[0], n[0] * 0.0 + 0.5)
    zero, one = n[0] * 0.0, n[0] * 0.0 + 1.0
    u = _unit(_cross(n, (select(side, one, zero), select(side, zero, one), zero)))
    v = _cross(n, u)
    values, c, s = _of_two(_form(A, u, u), _form(A, u, v), _form(A, v, v))
    p = (c * u[0] + s * v[0], c * u[1] + s * v[1], c * u[2] + s * v[2])
    q = (c * v[0] - s * u[0], c * v[1] - s * u[1], c * v[2] - s * u[2])
    return (_form(A, n, n), values[0], values[1]), (n[0], p[0], q[0], n[1], p[1], q[1], n[2], p[2], q[2])
