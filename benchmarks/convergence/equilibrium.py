"""Equilibria and vibrations of a finite-element body: Newton's method on its energy, and a banded Cholesky solver.

The factorisation also says whether a stiffness matrix is positive definite. Where it is not, the step uses the
convex part of the energy's second derivative at each point. So the search only descends, and ends in a minimum of the
energy: a stable equilibrium. That matters at the edges of a clamp. Their stress is singular, and under a large load the
surface beside the compressed edge buckles into creases far smaller than the body. Newton's method alone stops there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import LinearOperator, eigsh

from benchmarks.convergence.elements import Elements, Material
from cqrun.plugin.contract import Array

CONVERGED = 1e-9
"""Last step of Newton's method, over the largest displacement: the error after it is much smaller."""

MOST_STEPS = 150
"""Steps of Newton's method after which a part of the load counts as failed."""

LEAST_PART = 1 / 64
"""Smallest part of the load that is added at once."""

Solve = Callable[[Array], Array]


class Held:
    """A body of which some unknowns are held at zero.

    Args:
        elements: the elements.
        free: (n, D) bool, the unknowns that move.
        material: their material.
    """

    def __init__(self, elements: Elements, free: Array, material: Material) -> None:
        self.elements, self.free, self.material = elements, free, material
        X = np.round(elements.X, 12)  # ordered along the first axis, so the band is two cross-sections wide
        order = np.lexsort(X.T[::-1])
        unknowns = (elements.D * order[:, None] + np.arange(elements.D)).ravel()
        self._order = unknowns[free.ravel()[unknowns]]
        self._stiffness_at_rest = self.reduced(elements.stiffness(material, np.zeros_like(elements.X)))

    def reduced(self, A: csc_matrix) -> csc_matrix:
        """Return the rows and columns of the free unknowns, in the order of the band."""
        return A[self._order][:, self._order].tocsc()

    def spread(self, values: Array) -> Array:
        """Return the displacement (n, D) of values of the free unknowns in the order of the band."""
        out = np.zeros(self.elements.X.size)
        out[self._order] = values
        return out.reshape(self.elements.X.shape)

    def solved(self, solve: Solve, forces: Array) -> Array:
        """Return the displacement (n, D) [m] that a solver gives for nodal forces (n, D) [N]."""
        return self.spread(solve(forces.ravel()[self._order]))

    def vibration(self, about: Array | None = None) -> tuple[float, Array]:
        """Return the lowest frequency [Hz] of small vibrations, and its mode (n, D).

        Args:
            about: displacement (n, D) [m] in equilibrium; the undeformed body if None.
        """
        K = self._stiffness_at_rest if about is None else self.reduced(self.elements.stiffness(self.material, about))
        M = self.reduced(self.elements.mass(self.material.density))
        inverse = LinearOperator(K.shape, matvec=factorised(K), dtype=float)
        squared, modes = eigsh(K, k=2, M=M, sigma=0.0, OPinv=inverse, v0=np.ones(K.shape[0]))
        least = int(np.argmin(squared))
        return float(np.sqrt(squared[least]) / (2.0 * np.pi)), self.spread(modes[:, least])

    def rest(self, load: Array, first: float = 1.0) -> Array:
        """Return the displacement (n, D) [m] at rest under nodal forces (n, D) [N].

        Args:
            first: part of the load that the first step adds; a part that fails is halved.

        Raises:
            RuntimeError: no equilibrium is found.
        """
        u, reached, part = np.zeros_like(load), 0.0, first
        while reached < 1.0:
            part = min(part, 1.0 - reached)
            trial = self._minimum(u, (reached + part) * load)
            if trial is not None:
                u, reached, part = trial, reached + part, 1.5 * part
            elif (part := 0.5 * part) < LEAST_PART:
                raise RuntimeError(f"no equilibrium found beyond {reached:.3g} of the load")
        return u

    def _minimum(self, u: Array, load: Array) -> Array | None:
        """Return the minimum of energy - load . u that a descent from u reaches; None if `MOST_STEPS` find none."""
        for _ in range(MOST_STEPS):
            downhill = (load - self.elements.forces(self.material, u)).ravel()[self._order]
            solve, exact = self._solver(u)
            step = self.spread(solve(downhill))
            if exact and np.abs(step).max() <= CONVERGED * np.abs(u).max():
                return u + step
            u = u + self._length(u, step, load, downhill) * step
        return None

    def _solver(self, u: Array) -> tuple[Solve, bool]:
        """Return a solver of the stiffness matrix at u, or of its convex part; and whether it is the first."""
        try:
            return factorised(self.reduced(self.elements.stiffness(self.material, u))), True
        except LinAlgError:
            return factorised(self.reduced(self.elements.stiffness(self.material, u, convex=True))), False

    def _length(self, u: Array, step: Array, load: Array, downhill: Array) -> float:
        """Return a length along a step that lowers the energy, or that makes its slope small.

        The second test is needed near the minimum, where differences of energies are round-off.
        """
        slope = -downhill @ step.ravel()[self._order]
        start, length = self._potential(u, load), 1.0
        while length > 1e-6:
            trial = u + length * step
            with np.errstate(invalid="ignore", divide="ignore"):
                lower = self._potential(trial, load) <= start + 1e-4 * length * slope
                residual = (self.elements.forces(self.material, trial) - load).ravel()[self._order]
            if np.isfinite(residual).all() and (lower or abs(residual @ step.ravel()[self._order]) <= 0.3 * abs(slope)):
                break
            length *= 0.5
        return length

    def _potential(self, u: Array, load: Array) -> float:
        return self.elements.energy(self.material, u) - float((load * u).sum())


def factorised(K: csc_matrix) -> Solve:
    """Return a solver of a banded matrix.

    Raises:
        LinAlgError: the matrix is not positive definite.
    """
    entries = K.tocoo()
    below = entries.row >= entries.col
    offset, column = (entries.row - entries.col)[below], entries.col[below]
    band = np.zeros((int(offset.max()) + 1, K.shape[0]))
    band[offset, column] = entries.data[below]
    if not np.isfinite(band).all():
        raise LinAlgError("the matrix has entries that are not finite")
    factors = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
    return lambda right: np.asarray(cho_solve_banded((factors, True), np.ravel(right), check_finite=False))
