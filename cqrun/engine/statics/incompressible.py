"""The preconditioner of bodies that keep their volume: its work does not grow as nu nears 1/2.

Mean pressures add R^T S R to the stiffness (volumes.py). S grows without bound as nu nears 1/2, and the products that
block Jacobi needs grow with it. With the blocks D of all the rest, the preconditioner is the inverse of D + R^T S R
(Sherman, Morrison, Woodbury):

    D^-1 - D^-1 R^T (S^-1 + R D^-1 R^T)^-1 R D^-1.

The inner matrix has a row for each corner, and is factorised. What is left to conjugate gradients is the spread of
D^-1 K without its volumes, whatever S is (an augmented preconditioner; M. Benzi, G. Golub, J. Liesen: Numerical
solution of saddle point problems, Acta Numerica 14 (2005), section 10).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from cqrun.engine.statics.volumes import MeanVolumes
from cqrun.plugin.contract import Array

MOST_CORNERS = 20_000
"""With more corners the factors would take gigabytes, and as long as the products that they save."""

LEAST = 1e-8
"""Least stiffness of a corner, as a part of the largest: a law may be soft, or even give way, at a large volume."""


class Squeeze:
    """What mean pressures change in a preconditioner, at one state.

    Args:
        volumes: prepared at that state.
        inverse: inverse of the blocks of the active nodes without their volumes (A, D, D), with only what is free.
        active: these nodes.
    """

    def __init__(self, volumes: MeanVolumes, inverse: Array, active: Array) -> None:
        d, n = volumes.dim, volumes.n_nodes
        ends = np.zeros(n + 1, np.int64)
        ends[active + 1] = 1
        blocks = sparse.bsr_array((inverse, active, np.cumsum(ends)), shape=(n * d, n * d)).tocsr()
        self.rows = volumes.rows
        self.spread = sparse.csr_array(blocks @ self.rows.T)
        stiffness = np.maximum(volumes.stiffness, LEAST * volumes.stiffness.max())
        inner = sparse.diags_array(1.0 / stiffness) + self.rows @ self.spread
        options = {"SymmetricMode": True}
        self.solver: Any = splu(inner.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)

    @property
    def size(self) -> int:
        """Its size in memory [bytes]."""
        return 12 * (int(self.solver.nnz) + int(self.spread.nnz))

    def change(self, z: Array) -> Array:
        """Return what it adds to displacements z = D^-1 r (M, D)."""
        return np.asarray(-(self.spread @ self.solver.solve(self.rows @ z.ravel()))).reshape(z.shape)
