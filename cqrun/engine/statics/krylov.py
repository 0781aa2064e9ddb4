"""Solvers of linear systems with a preconditioner: conjugate gradients, and GMRES for matrices that are not symmetric.

The steps of conjugate gradients contain a tridiagonal matrix (Lanczos) whose smallest eigenvalue approaches that of the
preconditioned matrix: how near a body is to a limit point (Y. Saad, Iterative Methods for Sparse Linear Systems,
section 6.7.3). The matrix may turn out to be indefinite.

GMRES knows nothing of eigenvalues. It is restarted, and preconditioned from the right, so that its residual is the true
one (section 9.3.2). Forces whose tangent is not symmetric act on few points, so it needs little more products than
conjugate gradients would.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh_tridiagonal

from cqrun.plugin.contract import Array

Linear = Callable[[Array], Array]

RESTART = 60
"""Products after which GMRES starts again: it keeps a vector for each."""


class Solution(NamedTuple):
    """What a solver found.

    Attributes:
        x: the approximate solution.
        iterations: number of products.
        negative: whether a direction of negative curvature ended the search; x is then the answer so far.
        smallest: smallest eigenvalue of the preconditioned matrix that was seen; NaN after less than 2 steps, and from
            GMRES.
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


def minimal_residuals(product: Linear, b: Array, precondition: Linear, relative: float, most: int) -> Solution:
    """Solve product(x) = b, whose matrix need not be symmetric, as `conjugate_gradients` does; by GMRES."""
    x, r, count = np.zeros_like(b), b.copy(), 0
    size = np.sqrt(dot(b, b))
    goal = relative * size
    while size > goal and count < most:
        change, steps = _cycle(product, r, size, precondition, goal, min(RESTART, most - count))
        x += precondition(change)
        r, before = b - product(x), size
        size, count = np.sqrt(dot(r, r)), count + steps + 1
        if not size < before:
            break
    return Solution(x, count, False, float("nan"), bool(size <= goal))


def _cycle(
    product: Linear, r: Array, size: float, precondition: Linear, goal: float, most: int
) -> tuple[Array, int]:  # fmt: skip
    """Return y that makes |r - product(precondition(y))| least in the space of `most` products, and their number.

    It ends early where the residual is small enough. Vectors are made orthogonal twice, which keeps them so to
    rounding; sums by einsum have the same order for any number of threads.
    """
    V, H = np.zeros((most + 1, r.size)), np.zeros((most + 1, most))
    V[0] = r.ravel() / size
    for k in range(most):
        w = product(precondition(V[k].reshape(r.shape))).ravel().copy()
        for _ in range(2):
            parts = np.einsum("kn,n->k", V[: k + 1], w)
            w -= np.einsum("k,kn->n", parts, V[: k + 1])
            H[: k + 1, k] += parts
        H[k + 1, k] = np.sqrt(dot(w, w))
        start = np.append(size, np.zeros(k + 1))
        y, *_ = np.linalg.lstsq(H[: k + 2, : k + 1], start, rcond=None)
        left = float(np.linalg.norm(start - H[: k + 2, : k + 1] @ y))
        if left <= goal or H[k + 1, k] == 0.0:
            break
        V[k + 1] = w / H[k + 1, k]
    return np.einsum("k,kn->n", y, V[: k + 1]).reshape(r.shape), k + 1


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
