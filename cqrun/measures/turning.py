"""Rotations of parts of a body from rest: the best rigid fit to their particles, its rotation vector, and the adjoint.

The best rotation R of positions x_p from rest positions X_p minimises sum_p |x_p - mean(x) - R (X_p - mean(X))|^2. It
is the rotation of the polar decomposition of A = sum_p x_p (X_p - mean(X))^T (Kabsch, Acta Cryst. A32, 1976). A is a
few weighted sums of positions, so a part of any size costs as much as a few particles.

In 2D the rotation vector is one angle. In 3D its length is the angle in rad, and its direction is the axis. If R turns
by a small phi, R -> exp([phi]x) R, the rotation vector r changes by J(r)^-1 phi with the left Jacobian J of SO(3):

    J(r)^-1 = I - [r]x / 2 + c [r]x^2,    c = 1 / t^2 - (1 + cos t) / (2 t sin t),    t = |r|
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from cqrun.errors import UsageError
from cqrun.measurements.rotation import axial, cross_matrix, rotation, rotation_vjp
from cqrun.observers.matter import Matter
from cqrun.observers.rows import weighted
from cqrun.plugin.contract import Array

if TYPE_CHECKING:
    from scipy.sparse import csr_array

THINNEST = 1e-6
"""Particles are on one line if their second extent is less than this part of the first."""

SMALL = 1e-2
"""Below this angle [rad], c is taken from its series."""


def turning_rows(matter: Matter, members: Array) -> csr_array:
    """Return the weights of the sums A of a part (D, N).

    Raises:
        UsageError: its particles are at one place, or in 3D on one line, so that they have no rotation.
    """
    X = matter.x[members] - matter.x[members].mean(axis=0)
    extents = np.linalg.svd(X, compute_uv=False)[: matter.dim - 1] if len(X) > 1 else np.zeros(1)
    if not extents[-1] > THINNEST * extents[0]:
        what = "at one place" if matter.dim == 2 else "on one line"
        raise UsageError(f"its particles are {what}, so they have no rotation: choose a larger part")
    return weighted([members] * matter.dim, list(X.T / (X * X).sum()), matter.n_particles)


def turned(sums: Array) -> Array:
    """Return the rotations R (T, D, D) from the sums A, as rows of positions (T, D, D): A is their transpose."""
    return rotation(np.swapaxes(sums, -1, -2))


def turned_vjp(sums: Array, R: Array, phi_bar: Array) -> Array:
    """Return the cotangent of the sums (T, D, D) from that of small turns phi of R: (T, 1) in 2D, (T, 3) in 3D."""
    if R.shape[-1] == 2:
        R_bar = 0.5 * phi_bar[:, :, None] * (np.array([[0.0, -1.0], [1.0, 0.0]]) @ R)
    else:
        R_bar = 0.5 * cross_matrix(phi_bar) @ R
    return np.swapaxes(rotation_vjp(np.swapaxes(sums, -1, -2), R, R_bar), -1, -2)


def rotation_vector(R: Array) -> Array:
    """Return the rotation vectors of rotations (T, D, D): (T, 1) in 2D, (T, 3) in 3D, of lengths up to pi [rad]."""
    if R.shape[-1] == 2:
        return np.arctan2(R[:, 1, 0], R[:, 0, 0])[:, None]
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_rotvec())


def rotation_vector_vjp(r: Array, r_bar: Array) -> Array:
    """Return the cotangent of small turns phi from that of rotation vectors r; both as `rotation_vector`."""
    if r.shape[1] == 1:
        return r_bar
    t = np.linalg.norm(r, axis=1)
    small = t < SMALL
    at = np.where(small, 1.0, t)
    c = np.where(small, 1.0 / 12.0 + t * t / 720.0, 1.0 / at**2 - (1.0 + np.cos(at)) / (2.0 * at * np.sin(at)))
    once = np.cross(r, r_bar)
    return np.asarray(r_bar + 0.5 * once + c[:, None] * np.cross(r, once))  # J^-T, as [r]x^T = -[r]x


def angle(R: Array) -> Array:
    """Return the angle of rotations in 3D (T, 3, 3): (T,), from 0 to pi [rad]."""
    return np.arctan2(np.linalg.norm(axial(R), axis=1), np.trace(R, axis1=1, axis2=2) - 1.0)


def unwrapped(vectors: Array) -> Array:
    """Return rotation vectors of successive moments (T, n), each as near as possible to the one before it.

    A full turn about its axis is added to a vector, or taken away, so that turns are counted on. Moments without a
    rotation are left out.
    """
    out = np.array(vectors)
    known = np.flatnonzero(np.isfinite(out).all(axis=1))
    if out.shape[1] == 1:
        out[known] = np.unwrap(out[known], axis=0)
        return out
    for before, k in itertools.pairwise(known):
        length = float(np.linalg.norm(out[k]))
        if length > 0.0:
            axis = out[k] / length
            out[k] += 2.0 * np.pi * np.round((out[before] @ axis - length) / (2.0 * np.pi)) * axis
    return out
