"""How fast waves are in deformed material.

A wave along N (a direction at rest) crosses a cell at rest in

    dx sqrt(rho / q),    q the largest eigenvalue of Q_ik = sum_JL dP_iJ/dF_kL N_J N_L    (the acoustic tensor)

and a cell of a grid that does not move with the material, as in the frame of the papers, in |F^-T N| of that time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cqrun.materials.term import has_history, kirchhoff
from cqrun.plugin.contract import Array

DIRECTIONS = 200
"""Directions N that are tried."""

DIFFERENCE = 1e-6
"""Of F, for slopes, in parts of its least stretch."""

WIDEST = 10.0
"""Stretch across a pulled body that is not exceeded."""

HALVINGS = 50
"""Of the interval in which the stretch across a pulled body lies."""


def nominal(terms: Sequence[Any], thetas: Sequence[Array], F: Array) -> Array:
    """Return the nominal stress P (D, D) [Pa] of a material at F (D, D), without its terms that have a history."""
    dim = len(F)
    flat, tau = tuple(F.ravel().tolist()), np.zeros(dim * dim)
    for term, theta in zip(terms, thetas, strict=True):
        if not has_history(type(term)):
            tau += np.array(kirchhoff(term, tuple(theta.tolist()), flat, (0.0,) * dim**2), float)
    return np.asarray(tau.reshape(dim, dim) @ np.linalg.inv(F).T)


def wave_stiffness(terms: Sequence[Any], thetas: Sequence[Array], F: Array, *, spatial: bool = False) -> float:
    """Return the largest eigenvalue of the acoustic tensor [Pa] of a material at F (D, D); 0 if it is not finite.

    Args:
        terms: kernels' views of the terms of a stress. Those with a history are left out.
        thetas: the parameters of each at one particle.
        spatial: whether the cells do not move with the material: then it is divided by |F^-T N|^2.
    """
    dim, h = len(F), DIFFERENCE * float(np.linalg.svd(F, compute_uv=False).min())
    A = np.zeros((dim, dim, dim, dim))
    for k in range(dim):
        for L in range(dim):
            change = np.zeros((dim, dim))
            change[k, L] = h
            A[:, :, k, L] = (nominal(terms, thetas, F + change) - nominal(terms, thetas, F - change)) / (2.0 * h)
    if not np.isfinite(A).all():
        return 0.0
    N = _directions(dim)
    Q = np.einsum("iJkL,nJ,nL->nik", A, N, N)
    if spatial:
        Q /= np.sum((N @ np.linalg.inv(F)) ** 2, axis=1)[:, None, None]
    return float(np.linalg.eigvalsh(0.5 * (Q + Q.transpose(0, 2, 1))).max())


def pulled(terms: Sequence[Any], thetas: Sequence[Array], stretch: float, dim: int) -> list[Array]:
    """Return deformation gradients (D, D) of a body that is pulled along x: a strip, and in 3D also a wide sheet.

    No force acts across it, and a sheet keeps its width.
    """
    across = [(1,)] if dim == 2 else [(1, 2), (1,)]
    return [_free_across(terms, thetas, stretch, dim, axes) for axes in across]


def _free_across(
    terms: Sequence[Any], thetas: Sequence[Array], stretch: float, dim: int, axes: tuple[int, ...]
) -> Array:
    """Return F with a stretch along x and no force along the axes."""
    low, high = stretch ** (-1.0 / len(axes)), 1.0
    F = np.eye(dim)
    F[0, 0] = stretch
    while high < WIDEST:  # a body whose shape resists more than its volume becomes wider
        F[axes, axes] = high
        if nominal(terms, thetas, F)[1, 1] > 0.0:
            break
        low, high = high, 1.2 * high
    for _ in range(HALVINGS):
        F[axes, axes] = middle = 0.5 * (low + high)
        low, high = (low, middle) if nominal(terms, thetas, F)[1, 1] > 0.0 else (middle, high)
    return F


def _directions(dim: int) -> Array:
    """Return unit vectors (n, D) that are spread evenly over half a circle or a sphere."""
    k = np.arange(DIRECTIONS)
    if dim == 2:
        return np.stack([np.cos(np.pi * k / DIRECTIONS), np.sin(np.pi * k / DIRECTIONS)], axis=1)
    z = 1.0 - (2.0 * k + 1.0) / DIRECTIONS
    turn = k * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([np.sqrt(1.0 - z * z) * np.cos(turn), np.sqrt(1.0 - z * z) * np.sin(turn), z], axis=1)
