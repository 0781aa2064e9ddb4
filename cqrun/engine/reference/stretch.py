"""How far particles are deformed: what the substep must be short enough for, and what no body can do.

Every WATCH substeps, and at the end of every control step, three particles are noted: the one with the least principal
stretch, the one that is stretched most, and the one with the least volume ratio J. If J <= 0 the material there is
turned inside out. Afterwards, `remarks.py` says what that means.

The singular values of F are found only where a cheap lower bound does not settle it,

    s_min >= |det F| ((D - 1) / |F|^2)^((D - 1) / 2)

(Y. Hong and C.-T. Pan, A lower bound for the smallest singular value, Linear Algebra Appl. 172 (1992), with |F| that of
Frobenius).
"""

from __future__ import annotations

import numpy as np

from cqrun.engine.arrays import load_F
from cqrun.engine.reference.setting import NodeRun
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import barrier, kernel
from cqrun.numerics.lanes import LANE_BYTES, lane
from cqrun.numerics.tensor import det, inner
from cqrun.plugin.contract import Array

WATCH = 16
"""Substeps after which deformations are noted: a wave crosses ten cells in that time at most."""

WILD = 900.0
"""Of |F|^2: beyond a stretch of 30 a run has blown up, and what it does there says nothing about the substep."""

LEAST, MOST, VOLUME = 0, 1, 2
"""Rows of `NodeRun.least`: the least principal stretch, the largest |F|^2, and the least volume ratio."""

VALUE, COLUMN, STEP, FIRST, MATRIX = 0, 1, 2, 3, 4
"""Entries of a row: the value, its column and substep, the first substep (J <= 0 alone), and where F begins."""


def no_watch() -> Array:
    """Return `NodeRun.least` before the first substep (6, 13); its last three rows are for work."""
    least = np.full((6, MATRIX + 9), -1.0)
    least[:, VALUE] = 1.0, 1.0, 1.0, 1.0, 1.0, 1.0
    least[MOST, VALUE] = 0.0
    return least


@kernel
def watch(run: NodeRun, step: int, crew: Crew) -> None:
    """Note how far the particles in `run.q` are deformed."""
    if crew.thread == 0:
        watch_stretch(run, 0, run.stencils.f.shape[0], step)
    barrier(run.arrivals, crew.n_threads)


@kernel
def watch_stretch(run: NodeRun, lo: int, hi: int, step: int) -> None:
    """Note how far the particles lo .. hi are deformed, on one thread; after a run blew up, only J is noted."""
    dims, width, least = run.setting.dims, LANE_BYTES // run.q.itemsize, run.least
    dim, J_least, most = len(dims), 1.0, 0.0
    for row in range(2):
        for k in range(least.shape[1]):
            least[3 + row, k] = least[row, k]
    for i in range(lo, hi, width):
        F = load_F(run.q, i, dims)
        J, square = det(F), inner(F, F)
        for k in range(width):
            size, ratio = lane(square, k), lane(J, k)
            most = max(most, size)
            if ratio < J_least:
                J_least = ratio
                if ratio < least[VOLUME, VALUE]:
                    note_particle(run, VOLUME, ratio, i + k, step)
            if size > least[3 + MOST, VALUE]:
                note_particle(run, 3 + MOST, size, i + k, step)
            bound = abs(ratio) * ((dim - 1.0) / size if dim == 3 else np.sqrt(1.0 / size))
            if bound < least[3 + LEAST, VALUE]:
                exact = least_singular_value(run, i + k)
                if exact < least[3 + LEAST, VALUE]:
                    note_particle(run, 3 + LEAST, exact, i + k, step)
    if J_least > 0.0 and most < WILD:
        for row in range(2):
            for k in range(least.shape[1]):
                least[row, k] = least[3 + row, k]
    elif J_least <= 0.0 and least[VOLUME, FIRST] < 0.0:
        least[VOLUME, FIRST] = step


@kernel
def note_particle(run: NodeRun, row: int, value: float, p: int, step: int) -> None:
    """Write a particle and its F to a row."""
    dim, w = len(run.setting.dims), run.q.shape[2]
    run.least[row, VALUE], run.least[row, COLUMN], run.least[row, STEP] = value, p, step
    for k in range(dim * dim):
        run.least[row, MATRIX + k] = run.q[p // w, 2 * dim + dim * dim + k, p % w]


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
