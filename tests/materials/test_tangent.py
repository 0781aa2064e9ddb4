"""The second derivative of an energy, A = dP/dF, from the adjoint of the stress: what equilibria need of every law."""

from __future__ import annotations

import numpy as np
import pytest
from constitutive import N, Term, elastic_names, make, richardson, states, t

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
ENERGIES = pytest.mark.parametrize("name", [*elastic_names(), "incompressibility", "incompressibility^4", "muscle"])


def piola(term: Term, F: np.ndarray) -> np.ndarray:
    """Return P = tau F^-T (N, D, D)."""
    return term.tau(F, np.zeros_like(F)) @ t(np.linalg.inv(F))


def tangent_times(term: Term, F: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Return A : Q (N, D, D) as engine/statics/tangent.py finds it: F_bar(tau_bar = Q G) - G^T Q^T P with G = F^-1."""
    G = np.linalg.inv(F)
    _, F_bar, _ = term.vjp(F, np.zeros_like(F), Q @ G)
    return F_bar - t(G) @ t(Q) @ piola(term, F)


@DIM
@ENERGIES
def test_the_tangent_is_the_directional_derivative_of_the_stress(name, dim, rng):
    term = make(name, dim, rng)
    F, Q = states(dim, rng)[0], rng.normal(size=(N, dim, dim))
    slope = richardson(lambda h: piola(term, F + h * Q))
    np.testing.assert_allclose(tangent_times(term, F, Q), slope, rtol=0, atol=1e-8 * np.abs(slope).max())


@DIM
@ENERGIES
def test_the_tangent_is_symmetric(name, dim, rng):
    """Because every stress here has an energy."""
    term = make(name, dim, rng)
    F = states(dim, rng)[0]
    Q1, Q2 = rng.normal(size=(2, N, dim, dim))
    one, two = (Q1 * tangent_times(term, F, Q2)).sum((1, 2)), (Q2 * tangent_times(term, F, Q1)).sum((1, 2))
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-13 * max(np.abs(one).max(), 1.0))
