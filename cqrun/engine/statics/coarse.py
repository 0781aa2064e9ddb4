"""A coarse space for the preconditioner: slow modes, which block Jacobi leaves to hundreds of products.

Quadratic splines nest: the spline of a node of a grid with twice the spacing, at the fine place 2 j + 1/2, is
(1, 3, 3, 1) / 4 of those of the fine nodes 2 j - 1 .. 2 j + 2. The coarse grid has four times the spacing, by twice
these weights. (Twice the spacing takes as many products, and its direct solves cost more than them.) With the weights
as P, held nodes left out, the coarse stiffness is P^T K P, and the preconditioner adds P (P^T K P)^-1 P^T to the
inverse of the diagonal blocks (two-level additive Schwarz; B. Smith, P. Bjorstad, W. Gropp, Domain Decomposition, 1996,
chapter 1).

A particle moves 3^D nodes of a grid of twice the spacing, as it moves 3^D fine ones. So the matrix of that grid is
assembled from the particles' tangents at the cost of about a hundred products. The coarse one follows, and is solved
directly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from cqrun.engine.exert import exert_of_each_vjp
from cqrun.engine.reference.ghost import THIRD
from cqrun.engine.reference.patches import Patches
from cqrun.engine.reference.setting import NodeRun
from cqrun.engine.setting import Crew, Drive
from cqrun.engine.statics.volumes import MeanVolumes
from cqrun.engine.stencils import node_of
from cqrun.forces.force import is_unsymmetric
from cqrun.numerics.compile import allocating_kernel
from cqrun.plugin.contract import Array

SHIFT = 1e-7
"""Part of the diagonal that is added to it: coarse splines may agree on all fine nodes of a thin body."""

MOST_PULLED = 600
"""Coordinates of points under forces of which the coarse space knows; each takes a pass over all forces."""

NEGLIGIBLE = 1e-14
"""Coarse nodes with a smaller part of the largest diagonal move nothing."""

INVERSE_ITERATIONS = 8
"""Enough for two digits of the smallest eigenvalue."""

FIRST_SHIFT, LAST_SHIFT = 1e-4, 1e4
"""Shifts that are tried to make an indefinite stiffness positive."""


class Pulled(NamedTuple):
    """Points on which forces act: the weights of nodes (P, M), and the stiffness of the forces (P D, P D); sparse."""

    weights: Any
    stiffness: Any


class CoarseSpace:
    """The coarse nodes of all bodies, and the inverse of their stiffness.

    Args:
        run: the nodes and particles of the fine grid.
        patches: their places.
        free: which fine nodes no boundary holds (M,) of bool.

    Attributes:
        ready: whether there is an inverse.
        moves: whether a coarse node can move at the last state.
    """

    def __init__(self, run: NodeRun, patches: Patches, free: Array) -> None:
        self.run, self.dim = run, patches.f.shape[1]
        twice, self.first, self.odd, self.strides, shapes = _prolongation(run, patches, free)
        self.n_twice = twice.shape[1]
        coarser, _ = _nested(shapes)
        self.P, self.n_coarse = twice @ coarser, coarser.shape[1]
        self.coarser = sparse.kron(coarser, sparse.eye_array(self.dim))
        self.free = free.astype(np.float64)
        self.used = np.zeros(0, np.int64)
        self.last: tuple[Array, Any, bool] = self.used, None, True  # rows and stiffness at the last state, its sign
        self.solver: Any = None

    @property
    def ready(self) -> bool:
        """Whether there is an inverse."""
        return self.solver is not None

    @property
    def moves(self) -> bool:
        """Whether a coarse node can move at the last state."""
        return len(self.last[0]) > 0

    @property
    def size(self) -> int:
        """Its size in memory [bytes]."""
        return 12 * self.solver.nnz if self.ready else 0

    def prepare(self, A: Array, ghosts: Any, pulled: Sequence[Pulled], volumes: MeanVolumes | None = None) -> bool:
        """Assemble and factorise the coarse stiffness, and return whether it is positive definite.

        If it is not, the last inverse stays: it is still a good preconditioner.

        Args:
            A: the tangents of all particles (`tangent.py`).
            ghosts: the ghost penalty, or none.
            pulled: forces on points.
            volumes: averaged volumes, or none.
        """
        K = self._stiffness(A, ghosts, pulled)
        if volumes is not None:
            K = K + volumes.coarse(self.P)
        diagonal = K.diagonal()
        used = np.flatnonzero(diagonal > NEGLIGIBLE * diagonal.max(initial=0.0))
        if not len(used):
            self.last = used, None, True
            return True
        K = K[used][:, used] + sparse.diags_array(SHIFT * diagonal[used])
        solver, definite = _factors(K)
        self.last = used, K, definite
        if definite:
            self.used, self.solver = used, solver
        return definite

    def solve(self, r: Array) -> Array:
        """Return P K_c^-1 P^T times the forces r (M, 4), as displacements of that shape."""
        return self._fine(self._inverse(self._coarse(r)))

    def smallest(self, blocks: Array, active: Array) -> float:
        """Return the smallest eigenvalue of the last stiffness relative to its diagonal blocks, by inverse iteration.

        Args:
            blocks: the diagonal blocks of the active nodes (A, D, D).
            active: these nodes.
        """
        if not self.last[2]:
            return self._most_negative(blocks, active)

        def weighted(coarse: Array) -> Array:
            x = self._fine(coarse)
            x[active, : self.dim] = np.einsum("nij,nj->ni", blocks, x[active, : self.dim])
            return self._coarse(x)

        v = np.random.default_rng(0).normal(size=len(self.used))
        b, value = weighted(v), np.nan
        for _ in range(INVERSE_ITERATIONS):
            w = self._inverse(b)
            weighted_w = weighted(w)
            value = float(w @ b) / float(w @ weighted_w)
            b = weighted_w / np.sqrt(float(w @ weighted_w))
        return value

    def _most_negative(self, blocks: Array, active: Array) -> float:
        """Return the smallest eigenvalue of an indefinite stiffness K relative to blocks B.

        Inverse iteration with K + s B, which is positive definite for a shift s beyond that eigenvalue, converges to
        it. A second shift, just beyond the estimate, gives the last digits.
        """
        (used, K, _), d = self.last, self.dim
        ends = np.zeros(self.P.shape[0] + 1, np.int64)
        ends[active + 1] = 1
        all_blocks = sparse.bsr_array((blocks, active, np.cumsum(ends)), shape=(d * self.P.shape[0],) * 2)
        moved = sparse.csc_array(sparse.kron(self.P, sparse.eye_array(d)))[:, used]
        B = sparse.csc_array(moved.T @ all_blocks @ moved)
        shift, value = FIRST_SHIFT, np.nan
        solver, definite = _factors(K + shift * B)
        while not definite and shift < LAST_SHIFT:
            shift *= 4.0
            solver, definite = _factors(K + shift * B)
        v = np.random.default_rng(0).normal(size=len(used))
        for closer in (True, False):
            for _ in range(INVERSE_ITERATIONS):
                v = solver.solve(B @ v)
                v /= np.sqrt(float(v @ (B @ v)))
            value = float(v @ (K @ v))
            if closer and value < 0.0:
                trial, definite = _factors(K - 1.1 * value * B)
                solver = trial if definite else solver
        return value

    def _coarse(self, r: Array) -> Array:
        return np.asarray(np.asarray(self.P.T @ r[:, : self.dim]).ravel()[self.used])

    def _inverse(self, b: Array) -> Array:
        return np.asarray(self.solver.solve(b))

    def _fine(self, coarse: Array) -> Array:
        full = np.zeros(self.n_coarse * self.dim)
        full[self.used] = coarse
        out = np.zeros((self.P.shape[0], 4))
        out[:, : self.dim] = self.P @ full.reshape(-1, self.dim)
        return out

    def _stiffness(self, A: Array, ghosts: Any, pulled: Sequence[Pulled]) -> Any:
        """Return the coarse stiffness (C D, C D) of particles, ghost penalty and forces on points; sparse."""
        d = self.dim
        blocks = np.zeros((self.n_twice, 5**d, d, d))
        add_coarse(self.run, A, self.free, self.first, np.array(self.strides), self.odd, WEIGHTS, blocks)
        K = self.coarser.T @ self._matrix(blocks) @ self.coarser
        for ghost in ghosts:
            count = len(ghost.run)
            place = np.repeat(np.arange(count), 4), ghost.run.ravel()
            third = sparse.csr_array((np.tile(THIRD, count), place), shape=(count, self.P.shape[0])) @ self.P
            K = K + sparse.kron(third.T @ sparse.diags_array(ghost.scale) @ third, sparse.eye_array(d))
        for points in pulled:
            moved = sparse.kron(points.weights @ self.P, sparse.eye_array(d))
            K = K + moved.T @ points.stiffness @ moved
        return sparse.csr_array(K)

    def _matrix(self, blocks: Array) -> Any:
        """Return the stiffness for twice the spacing as a sparse matrix, from the blocks of nodes and neighbours."""
        d, n = self.dim, self.n_twice
        offsets = np.stack(np.meshgrid(*[np.arange(-2, 3)] * d, indexing="ij"), -1).reshape(-1, d)
        steps = offsets @ np.array(self.strides[3 - d :])
        rows, column = np.repeat(np.arange(n), 5**d), (np.arange(n)[:, None] + steps).ravel()
        flat = blocks.reshape(-1, d, d)
        kept = np.flatnonzero(np.any(flat != 0.0, axis=(1, 2)))
        i = (d * rows[kept])[:, None, None] + np.arange(d)[:, None] + np.zeros(d, int)
        j = (d * column[kept])[:, None, None] + np.arange(d)[None, :] + np.zeros((d, 1), int)
        return sparse.csr_array((flat[kept].ravel(), (i.ravel(), j.ravel())), shape=(n * d, n * d))


def _factors(K: Any) -> tuple[Any, bool]:
    """Return the factors of a symmetric matrix, and whether it is positive definite.

    Without pivoting the signs of the pivots are those of the eigenvalues (Sylvester).
    """
    solver = splu(K.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return solver, bool((solver.U.diagonal() > 0.0).all())


def pulled_points(run: NodeRun, loads: Any, drive: Drive, control: int) -> list[Pulled]:
    """Return the stiffness of forces on points where they are now; those on many points are left out.

    Of an unsymmetric one it is the symmetric part: good enough for a preconditioner.

    Args:
        loads: of a rollout of the reference frame.
    """
    found: list[Pulled] = []
    for load in loads:
        points, pulled, push = load.points, load.pulled, load.push
        (count, reach), (_, d, width) = points.node.shape, push.shape
        if not 0 < count * d <= MOST_PULLED:
            continue
        place = np.searchsorted(pulled.columns, pulled.shares.columns)
        K = np.zeros((count * d, count, d))
        push[...] = 0.0
        for k in range(count):
            for axis in range(d):
                push[k // width, axis, k % width] = 1.0
                exert_of_each_vjp(drive.forces, drive.levels, control, load.q, push, Crew(0, 1))
                push[k // width, axis, k % width] = 0.0
                np.add.at(K[k * d + axis], place, -pulled.shares.x_bar)
        K = K.reshape(count * d, count * d)
        if any(is_unsymmetric(type(force)) for force in drive.forces):
            K = 0.5 * (K + K.T)
        nodes = np.repeat(np.arange(count), reach), points.node.ravel()
        weights = sparse.csr_array((points.weight.ravel(), nodes), shape=(count, len(run.nodes.mass)))
        found.append(Pulled(weights, sparse.csr_array(K)))
    return found


Shape = tuple[int, ...]
"""Numbers of nodes of a grid along its axes."""


def _nested(shapes: Sequence[Shape]) -> tuple[Any, list[Shape]]:
    """Return the weights of the splines of grids, one after the other, in those of grids of twice the spacing.

    Args:
        shapes: numbers of nodes along each axis, of each grid.

    Returns:
        a sparse matrix with a row for each node and a column for each coarse node; and the shapes of the coarse grids.
    """
    rows, columns, weights, coarse_shapes, row, column = [], [], [], [], 0, 0
    for shape in shapes:
        coarse = tuple(n // 2 + 2 for n in shape)
        index, count = np.indices(shape).reshape(len(shape), -1), int(np.prod(shape))
        pairs = [((i // 2, 0.75), (i // 2 + np.where(i % 2, 1, -1), 0.25)) for i in index]
        for which in np.ndindex(*(2,) * len(shape)):
            chosen = [pairs[axis][k] for axis, k in enumerate(which)]
            rows.append(row + np.arange(count))
            columns.append(column + np.ravel_multi_index(tuple(c + 1 for c, _ in chosen), coarse))
            weights.append(np.full(count, float(np.prod([w for _, w in chosen]))))
        coarse_shapes.append(coarse)
        row, column = row + count, column + int(np.prod(coarse))
    entries = [np.concatenate(part) for part in (weights, rows, columns)]
    return sparse.csr_array((entries[0], (entries[1], entries[2])), shape=(row, column)), coarse_shapes


def _prolongation(run: NodeRun, patches: Patches, free: Array) -> tuple[Any, Array, Array, Shape, list[Shape]]:
    """Return the weights of nodes that can move in the splines of twice the spacing (M, C), a sparse matrix.

    Then of each column of particles its first node of that grid (n,), and whether its first fine node is odd (n, 3).
    The last two are the strides of that grid's nodes, and its shape for each body.
    """
    d = patches.f.shape[1]
    box = tuple(int(b) for b in patches.box)
    inner = np.append(np.cumprod([b // 2 + 2 for b in box[:0:-1]])[::-1], 1).astype(int)
    strides = (0, *inner.tolist()) if d == 2 else tuple(inner.tolist())
    first, odd = np.zeros(len(patches.first), np.int64), np.zeros((len(patches.first), 3), np.int64)
    shapes, begin = [], 0
    for low, shape in zip(patches.begin[:-1].tolist(), patches.shapes(), strict=True):
        high = low + int(np.prod(shape))
        shapes.append(shape)
        own = np.flatnonzero((patches.first >= low) & (patches.first < high))
        at = np.unravel_index(patches.first[own] - low, shapes[-1])
        odd[own, 3 - d :] = np.stack(at, axis=1) % 2
        first[own] = begin + sum((i // 2 + i % 2) * inner[axis] for axis, i in enumerate(at))
        begin += (shapes[-1][0] // 2 + 2) * int(inner[0])
    weights, coarse = _nested(shapes)
    moved = np.zeros(patches.n_nodes, bool)
    moved[run.nodes.active] = True
    weights = sparse.csr_array(weights)[patches.in_boxes()]
    return sparse.diags_array((free & moved).astype(float)) @ weights, first, odd, strides, coarse


WEIGHTS = np.array([
    [[0.25, 0.75, 0.0], [0.0, 0.75, 0.25], [0.0, 0.25, 0.75]],
    [[0.75, 0.25, 0.0], [0.25, 0.75, 0.0], [0.0, 0.75, 0.25]],
])  # fmt: skip
"""Weights of three fine nodes in a row in three coarse splines, if the first fine node is even, or odd."""


@allocating_kernel
def add_coarse(
    run: NodeRun, A: Array, free: Array, first: Array, strides: Array, odd: Array, weights: Array, blocks: Array
) -> None:
    """Add the coarse stiffness blocks (C, 5^D, D, D) of all particles; on one thread.

    Args:
        free: 1 for fine nodes that can move, 0 for others (M,).
        first: the first coarse node of each column (n,).
        odd: (n, 3) 1 where the first fine node of a column is odd along an axis.
        weights: WEIGHTS (2, 3, 3).
    """
    setting, dim, width = run.setting, len(run.setting.dims), A.shape[2]
    ways = 3 if dim == 3 else 1
    w, d = np.zeros((3, 3)), np.zeros(3)
    G, B = np.zeros((27, 3)), np.zeros((9, 3))
    for p in range(len(first)):
        for axis in range(3):
            f = run.stencils.f[p, axis]
            w[axis, 0], w[axis, 1], w[axis, 2] = 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2
        G[:] = 0.0
        for a in range(ways):
            for b in range(3):
                for c in range(3):
                    n = node_of(run.stencils, run.stencils.first[p], a, b, c, setting.strides)
                    weight = (w[0, a] if dim == 3 else 1.0) * w[1, b] * w[2, c] * 4.0 / setting.dx * free[n]
                    if weight == 0.0:
                        continue
                    d[0], d[1], d[2] = a - run.stencils.f[p, 0], b - run.stencils.f[p, 1], c - run.stencils.f[p, 2]
                    for k in range(ways):
                        wa = weights[odd[p, 0], a, k] if dim == 3 else 1.0
                        for m in range(3):
                            for q in range(3):
                                part = weight * wa * weights[odd[p, 1], b, m] * weights[odd[p, 2], c, q]
                                for j in range(dim):
                                    G[9 * k + 3 * m + q, j] += part * d[j + 3 - dim]
        for m in range(9 * ways):
            for row in range(dim * dim):
                for k in range(dim):
                    total = 0.0
                    for q in range(dim):
                        column = k * dim + q
                        high, low = (row, column) if row >= column else (column, row)
                        total += A[p // width, high * (high + 1) // 2 + low, p % width] * G[m, q]
                    B[row, k] = total
            ma, mb, mc = m // 9, m // 3 % 3, m % 3
            for l in range(9 * ways):
                la, lb, lc = l // 9, l // 3 % 3, l % 3
                node = first[p] + la * strides[0] + lb * strides[1] + lc * strides[2]
                to = ((ma - la + 2) * 5 if dim == 3 else 0) * 5 + (mb - lb + 2) * 5 + (mc - lc + 2)
                for i in range(dim):
                    for k in range(dim):
                        total = 0.0
                        for j in range(dim):
                            total += G[l, j] * B[i * dim + j, k]
                        blocks[node, to, i, k] += total
