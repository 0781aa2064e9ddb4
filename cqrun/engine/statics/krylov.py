"""Conjugate gradients with a preconditioner, for a symmetric matrix that may turn out to be indefinite.

The steps of the method contain a tridiagonal matrix (Lanczos) whose smallest eigenvalue approaches that of the
preconditioned matrix: how near a body is to a limit point (Y. Saad, Iterative Methods for Sparse Linear Systems,
section 6.7.3).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh_tridiagonal

from cqrun.plugin.contract import Array

Linear = Callable[[Array], Array]


class Solution(NamedTuple):
    """What conjugate gradients found.

    Attributes:
        x: the approximate solution.
        iterations: number of products.
        negative: whether a direction of negative curvature ended the search; x is then the answer so far.
        smallest: smallest eigenvalue of the preconditioned matrix that was seen; NaN after less than 2 steps.
        converged: whether the residual is small enough.
    """

    x: Array
    iterations: int
    negative: bool
    smallest: float
    converged: bool


def dot(a: Array, b: Array) -> float:
    """Return the scalar product; NumPy's pairwise sum gives the same bits for any number of threads."""
    return float((a * b).sum())


def conjugate_gradients(product: Linear, b: Array, precondition: Linear, relative: float, most: int) -> Solution:
    """Solve product(x) = b until the residual is `relative` times |b|, or for `most` products."""
    x, r = np.zeros_like(b), b.copy()
    if not b.any():
        return Solution(x, 0, False, float("nan"), True)
    z = precondition(r)
    p, rz, goal = z.copy(), dot(r, z), relative * np.sqrt(dot(b, b))
    alphas: list[float] = []
    betas: list[float] = []
    for k in range(most):
        Kp = product(p)
        curvature = dot(p, Kp)
        if curvature <= 0.0:
            return Solution(x if k else z, k + 1, True, _smallest(alphas, betas), False)
        alphas.append(rz / curvature)
        x += alphas[-1] * p
        r -= alphas[-1] * Kp
        if np.sqrt(dot(r, r)) <= goal:
            return Solution(x, k + 1, False, _smallest(alphas, betas), True)
        z = precondition(r)
        rz, before = dot(r, z), rz
        betas.append(rz / before)
        p = z + betas[-1] * p
    return Solution(x, most, False, _smallest(alphas, betas), False)


def _smallest(alphas: list[float], betas: list[float]) -> float:
    """Return the smallest eigenvalue of the tridiagonal matrix of the steps."""
    if len(alphas) < 2:
        return float("nan")
    inverse, used = 1.0 / np.array(alphas), np.array(betas[: len(alphas) - 1])
    diagonal = inverse + np.concatenate([[0.0], used * inverse[:-1]])
    values = eigh_tridiagonal(
        diagonal, np.sqrt(used) * inverse[:-1], eigvals_only=True, select="i", select_range=(0, 0)
    )
    return float(values[0])
