"""GMRES: linear systems whose matrix is not symmetric."""

from __future__ import annotations

import numpy as np

from cqrun.engine.statics.krylov import minimal_residuals


def test_gmres_solves_what_is_not_symmetric(rng):
    n = 300
    A, B = rng.normal(size=(n, n)), rng.normal(size=(20, 20))
    K = A @ A.T / n + 0.05 * np.eye(n)
    K[:20, :20] += 0.3 * (B - B.T)
    b, scale = rng.normal(size=n), 1.0 / np.diag(K)
    found = minimal_residuals(lambda p: K @ p, b, lambda r: scale * r, 1e-10, 2000)
    assert found.converged
    assert 60 < found.iterations < 400  # it started again
    assert np.linalg.norm(K @ found.x - b) < 1.1e-10 * np.linalg.norm(b)


def test_gmres_says_what_it_cannot_solve(rng):
    turn = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    found = minimal_residuals(lambda p: turn @ p, np.array([0.0, 0.0, 1.0]), lambda r: r, 1e-8, 100)
    assert not found.converged
    few = minimal_residuals(lambda p: np.arange(1.0, 101.0) * p, np.ones(100), lambda r: r, 1e-12, 5)
    assert not few.converged
    assert few.iterations <= 6
    nothing = minimal_residuals(lambda p: p, np.zeros(5), lambda r: r, 1e-8, 5)
    assert nothing.converged
    assert not nothing.x.any()
