"""The rotation R of deformation gradients F = R S (polar decomposition), and its adjoint.

dR = R [w]x with (tr(S) I - S) w = axl(R^T dF - dF^T R). This does not divide by differences of
singular values, so it is smooth at rest (F = I) too. R is a rotation even if det F < 0.
"""

from __future__ import annotations

import numpy as np

from cqrun.errors import CrushedError
from cqrun.plugin.contract import Array

_SINGULAR = 1e-12


def rotation(F: Array) -> Array:
    """Return the rotations R (..., D, D) of F (..., D, D), D = 2 or 3.

    Raises:
        CrushedError: an F is so singular that its rotation is undefined.
    """
    if F.shape[-1] == 2:
        cosine, sine = F[..., 0, 0] + F[..., 1, 1], F[..., 1, 0] - F[..., 0, 1]
        trace = np.hypot(cosine, sine)
        _check(trace, np.abs(F).max(axis=(-1, -2)))
        cosine, sine = cosine / trace, sine / trace
        return np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)
    U, s, Vt = np.linalg.svd(F)
    sign = np.where(np.linalg.det(U) * np.linalg.det(Vt) < 0, -1.0, 1.0)
    _check(s[..., 1] + sign * s[..., 2], s[..., 0])
    U[..., 2] *= sign[..., None]
    return np.asarray(U @ Vt)


def rotation_vjp(F: Array, R: Array, R_bar: Array) -> Array:
    """Return the cotangent of F from the cotangent of R = rotation(F), all (..., D, D)."""
    Rt = np.swapaxes(R, -1, -2)
    S, B = Rt @ F, Rt @ R_bar
    if F.shape[-1] == 2:
        w = (B[..., 1, 0] - B[..., 0, 1]) / (S[..., 0, 0] + S[..., 1, 1])
        return np.asarray(w[..., None, None] * (R @ np.array([[0.0, -1.0], [1.0, 0.0]])))
    trace = np.trace(S, axis1=-2, axis2=-1)[..., None, None]
    w = np.linalg.solve(trace * np.eye(3) - S, axial(B)[..., None])[..., 0]
    return np.asarray(R @ cross_matrix(w))


def axial(A: Array) -> Array:
    """Return twice the axial vector (..., 3) of the skew part of A (..., 3, 3)."""
    return np.stack([A[..., 2, 1] - A[..., 1, 2], A[..., 0, 2] - A[..., 2, 0], A[..., 1, 0] - A[..., 0, 1]], -1)


def cross_matrix(w: Array) -> Array:
    """Return [w]x (..., 3, 3), so that [w]x a = w x a."""
    A = np.zeros((*w.shape, 3))
    A[..., 2, 1], A[..., 0, 2], A[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    return A - np.swapaxes(A, -1, -2)


def _check(denominator: Array, scale: Array) -> None:
    """Raise a CrushedError if the two smallest signed singular values of an F sum to about zero."""
    bad = ~(denominator > _SINGULAR * scale)
    if bad.any():
        where = tuple(int(i[0]) for i in np.nonzero(bad))
        raise CrushedError(
            f"the material at a marker is crushed (time and marker indices {where}): it has no rotation",
            "narrow the bounds of the unknowns or shorten the substep",
        )
