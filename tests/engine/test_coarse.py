"""The coarse space of equilibria: it is the stiffness of coarse splines, and makes conjugate gradients fast."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from little_worlds import Wall, below, needs_jit, world
from test_reference_frame import ELASTIC, SHEAR
from test_statics import cantilever

from cqrun.boundaries.sticky import Sticky
from cqrun.engine.model import GroupModel
from cqrun.engine.statics import precondition as statics
from cqrun.engine.statics.coarse import WEIGHTS
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.krylov import conjugate_gradients, dot


@pytest.fixture
def always(monkeypatch):
    """Use a coarse space from the first product on."""
    monkeypatch.setattr(statics, "REFRESH", -1)


def rod(length, *, push=0.0, gravity=0.0, E=4e4):
    """Return a slender 2D rod, 3 cells thick, that is clamped at its left end, pushed along itself and sagging."""
    axes = [0.225 + 0.05 * np.arange(count) for count in (length, 6)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    volume = 0.05**2
    model, inputs = world(
        x, size=[0.05 * length + 0.6, 1.0], dx=0.1, dt=1e-3, substeps=1, controls=1, mass=volume, volume=volume,
        E=E, nu=0.3, gravity=[0.0, gravity], walls=[Wall(Sticky, (0.0, 0.0), below(0, 0.3))],
    )  # fmt: skip
    end = np.flatnonzero(x[:, 0] > x[:, 0].max() - 1e-9)
    inputs.fields.force[end, 0] -= push / len(end)
    inputs.strength[:] = 0.0
    inputs.terms = [[inputs.terms[0][k] for k in (0, 1, 3)]]
    shear = (SHEAR[0], SHEAR[1], SHEAR[3])
    return replace(
        model, frame="reference", groups=(GroupModel((0,), ELASTIC, model.groups[0].active, shear=shear),)
    ), inputs


@pytest.mark.parametrize(("dim", "slit"), [(2, False), (3, False), (2, True), (3, True)])
def test_the_coarse_stiffness_is_that_of_the_fine_one(always, dim, slit, rng):
    """P^T K P of particles, ghost penalty, a taut cable and one with a tension, product by product."""
    model, inputs = cantilever(dim, slit=slit)
    equilibrium = Equilibrium(model, inputs)
    rest = equilibrium.solve()
    equilibrium.linearise(rest.u)
    assert equilibrium.preconditioner.add_coarse()
    coarse = equilibrium.preconditioner.coarse
    r = equilibrium.rollout
    pulled = statics.pulled_points(equilibrium.run, r.loads, r.drive, equilibrium.control)
    K = coarse._stiffness(equilibrium.A, r.ghosts, pulled)
    assert abs(K - K.T).max() <= 1e-12 * abs(K).max()
    for _ in range(3):
        v = rng.normal(size=coarse.n_coarse * dim)
        fine = np.zeros_like(rest.u)
        fine[:, :dim] = coarse.P @ v.reshape(-1, dim)
        want = (coarse.P.T @ equilibrium.product(fine)[:, :dim]).ravel()
        np.testing.assert_allclose(K @ v, want, rtol=0, atol=1e-11 * np.abs(want).max())


def test_splines_of_twice_the_spacing_nest():
    """Each fine node belongs to two coarse splines with 3/4 and 1/4, in every row of the tables."""
    np.testing.assert_array_equal(WEIGHTS.sum(axis=2), 1.0)
    assert set(np.unique(WEIGHTS)) == {0.0, 0.25, 0.75}


@pytest.mark.parametrize("dim", [2, 3])
def test_the_preconditioner_is_symmetric_and_positive(always, dim, rng):
    equilibrium = Equilibrium(*cantilever(dim))
    equilibrium.linearise(np.zeros_like(equilibrium.outside))
    assert equilibrium.preconditioner.coarse.ready
    p, q = (equilibrium.holding.freed(rng.normal(size=equilibrium.outside.shape)) for _ in range(2))
    for a in (p, q):
        a[:, dim:] = 0.0
        a[np.setdiff1d(np.arange(len(a)), equilibrium.run.nodes.active)] = 0.0
    Mp, Mq = equilibrium.precondition(p), equilibrium.precondition(q)
    assert dot(q, Mp) == pytest.approx(dot(p, Mq), rel=1e-10)
    assert dot(p, Mp) > 0


@needs_jit
def test_a_slender_rod_needs_few_products_and_rests_in_the_same_place(monkeypatch):
    model, inputs = rod(120, gravity=-0.8)
    found = {}
    for refresh in (50, 10**9):
        monkeypatch.setattr(statics, "REFRESH", refresh)
        equilibrium = Equilibrium(model, inputs)
        rest = equilibrium.solve(tolerance=1e-9)
        assert rest.converged
        equilibrium.linearise(rest.u)
        b = equilibrium.holding.freed(equilibrium.outside)
        solved = conjugate_gradients(equilibrium.product, b, equilibrium.precondition, 1e-8, 5000)
        found[refresh] = rest, solved
    (fast, fast_cg), (slow, slow_cg) = found.values()
    assert np.abs(fast.u).max() > 0.3
    np.testing.assert_allclose(fast.u, slow.u, rtol=0, atol=1e-7 * np.abs(slow.u).max())
    assert 3 * fast_cg.iterations < slow_cg.iterations
    assert 3 * fast.products < slow.products


def test_the_smallest_eigenvalue_is_that_of_the_coarse_pencil(always):
    equilibrium = Equilibrium(*cantilever(2))
    equilibrium.linearise(np.zeros_like(equilibrium.outside))
    coarse, active = equilibrium.preconditioner.coarse, equilibrium.run.nodes.active
    blocks = np.linalg.inv(equilibrium.preconditioner.inverse)
    n = len(coarse.used)
    unit = np.eye(n)

    def blocks_times(v):
        x = coarse._fine(v)
        x[active, :2] = np.einsum("nij,nj->ni", blocks, x[active, :2])
        return coarse._coarse(x)

    D = np.array([blocks_times(e) for e in unit])
    K = np.linalg.inv(np.array([coarse._inverse(e) for e in unit]))
    D, K = 0.5 * (D + D.T), 0.5 * (K + K.T)
    values = scipy.linalg.eigh(K, D + 1e-12 * np.trace(D) / n * unit, eigvals_only=True)
    assert coarse.smallest(blocks, active) == pytest.approx(values[0], rel=0.02)


@needs_jit
def test_the_smallest_eigenvalue_falls_to_zero_at_the_buckling_load(monkeypatch):
    """Euler: a clamped column of length L buckles at pi^2 EI / (4 L^2); plane strain stiffens it by 1 / (1 - nu^2).

    The stiffness against bending falls with the load in proportion, and is negative beyond the buckling load.
    """
    L, h, E, nu = 60 * 0.05 - 0.1, 0.3, 4e4, 0.3
    euler = np.pi**2 * E / (1 - nu**2) * h**3 / 12 / (4 * L**2)
    seen = {}
    for part in (0.3, 0.8, 1.2):
        monkeypatch.setattr(statics, "REFRESH", 10**9)  # so that Newton stays on the straight branch
        model, inputs = rod(60, push=part * euler)
        straight = Equilibrium(model, inputs).solve(tolerance=1e-7)
        assert straight.converged
        monkeypatch.setattr(statics, "REFRESH", -1)
        seen[part] = Equilibrium(model, inputs)._judged(straight)
    assert [seen[part].negative for part in seen] == [False, False, True]
    assert seen[0.8].smallest / seen[0.3].smallest == pytest.approx(0.2 / 0.7, rel=0.1)


@needs_jit
def test_any_number_of_threads_gives_the_same_bits(always):
    model, inputs = cantilever(2)
    found = []
    for threads in (1, 2, 3):
        equilibrium = Equilibrium(model, inputs, threads=threads)
        rest = equilibrium.solve()
        found.append((rest.u.tobytes(), rest.smallest, rest.products))
    assert found[0] == found[1] == found[2]
