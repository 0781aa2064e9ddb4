"""The least principal stretch of the particles, which shortens the largest stable substep.

A wave in material that is compressed to the stretch s crosses its cell 1 / s times as fast, so the limit of the substep
shrinks by about s (measured: at s = 0.4 it is 0.48 dx / c for neo-Hookean, at a stretch of 3, where s = 0.58 across,
0.46). The singular values of F are found only where a cheap lower bound does not settle it,

    s_min >= |det F| ((D - 1) / |F|^2)^((D - 1) / 2)

(Y. Hong and C.-T. Pan, A lower bound for the smallest singular value, Linear Algebra Appl. 172 (1992), with |F| that of
Frobenius).
"""

from __future__ import annotations

import numpy as np

from cqrun.engine.arrays import load_F
from cqrun.engine.reference.setting import NodeRun
from cqrun.numerics.compile import kernel
from cqrun.numerics.lanes import LANE_BYTES, lane
from cqrun.numerics.tensor import det, inner

LIMIT = 0.8
"""Largest stable substep at stretch 1, in dx / c, for bodies that are deformed in any way."""

LEAST, COLUMN, STEP = 0, 1, 2
"""Entries of `NodeRun.least`."""


@kernel
def watch_stretch(run: NodeRun, lo: int, hi: int, step: int) -> None:
    """Note the least principal stretch of the particles lo .. hi in `run.q`, on one thread."""
    dims, width = run.setting.dims, LANE_BYTES // run.q.itemsize
    dim = len(dims)
    for i in range(lo, hi, width):
        F = load_F(run.q, i, dims)
        J, square = det(F), inner(F, F)
        for k in range(width):
            size = lane(square, k)
            bound = abs(lane(J, k)) * ((dim - 1.0) / size if dim == 3 else np.sqrt(1.0 / size))
            if bound < run.least[LEAST]:
                exact = least_singular_value(run, i + k)
                if exact < run.least[LEAST]:
                    run.least[LEAST], run.least[COLUMN], run.least[STEP] = exact, i + k, step


@kernel
def least_singular_value(run: NodeRun, p: int) -> float:
    """Return the smallest singular value of a particle's F: the root of the smallest eigenvalue of F^T F."""
    dim, w = len(run.setting.dims), run.q.shape[2]
    first = 2 * dim + dim * dim  # F follows x, v and C
    a00 = a01 = a02 = a11 = a12 = a22 = 0.0
    for row in range(dim):
        f0 = run.q[p // w, first + row * dim, p % w]
        f1 = run.q[p // w, first + row * dim + 1, p % w]
        f2 = run.q[p // w, first + row * dim + 2, p % w] if dim == 3 else 0.0
        a00, a01, a02 = a00 + f0 * f0, a01 + f0 * f1, a02 + f0 * f2
        a11, a12, a22 = a11 + f1 * f1, a12 + f1 * f2, a22 + f2 * f2
    if dim == 2:
        return float(np.sqrt(max(0.5 * (a00 + a11) - np.hypot(0.5 * (a00 - a11), a01), 0.0)))
    # a symmetric 3 x 3 matrix: the trigonometric solution of its characteristic equation
    mean = (a00 + a11 + a22) / 3.0
    b00, b11, b22 = a00 - mean, a11 - mean, a22 - mean
    spread = np.sqrt((b00 * b00 + b11 * b11 + b22 * b22 + 2.0 * (a01 * a01 + a02 * a02 + a12 * a12)) / 6.0)
    if spread <= 1e-14 * mean:
        return float(np.sqrt(mean))
    half = b00 * (b11 * b22 - a12 * a12) - a01 * (a01 * b22 - a12 * a02) + a02 * (a01 * a12 - b11 * a02)
    half = min(max(half / (2.0 * spread**3), -1.0), 1.0)
    return float(np.sqrt(max(mean + 2.0 * spread * np.cos(np.arccos(half) / 3.0 + 2.0 * np.pi / 3.0), 0.0)))
