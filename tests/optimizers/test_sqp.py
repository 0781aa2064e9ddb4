"""The parts of `sqp`: curvature from recent steps, quadratic programs, and problems with thousands of unknowns."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import LinearConstraint, minimize
from toy_problems import Confined, InNumbers, Killed, Nearest, OnACircle, Rosenbrock, bits, history_rows, solve

from cqrun.optimizers import sqp
from cqrun.optimizers.quadratic_program import LowRank, quadratic_program
from cqrun.optimizers.sqp import Curvature, Sqp

NO_MULTIPLIERS = np.zeros(0)


def curvature_of_quadratic(rng, n=8, pairs=5, memory=20):
    """Return the curvature from steps in a convex quadratic without constraints, and the pairs (s, y)."""
    root = rng.normal(size=(n, n))
    H = root @ root.T + np.eye(n)
    steps = [rng.normal(size=n) for _ in range(pairs)]
    curvature = Curvature(memory)
    for s in steps:
        curvature.update(s, H @ s, np.zeros((0, n)))
    return curvature, [(s, H @ s) for s in steps]


def dense(curvature, n, y=NO_MULTIPLIERS):
    B = curvature.of(y)
    return np.array([B.times(e) for e in np.eye(n)]).T


def test_curvature_agrees_with_bfgs(rng):
    """From the same multiple of the identity, by the recursion (Nocedal and Wright, eq 6.19)."""
    curvature, pairs = curvature_of_quadratic(rng)
    B = curvature.of(NO_MULTIPLIERS).delta * np.eye(8)
    for s, y in pairs:
        Bs = B @ s
        B += np.outer(y, y) / (s @ y) - np.outer(Bs, Bs) / (s @ Bs)
    np.testing.assert_allclose(dense(curvature, 8), B, rtol=1e-9, atol=1e-9)


def test_curvature_forgets_old_steps(rng):
    curvature, pairs = curvature_of_quadratic(rng, memory=3)
    fresh = Curvature(3)
    for s, y in pairs[-3:]:
        fresh.update(s, y, np.zeros((0, 8)))
    np.testing.assert_allclose(dense(curvature, 8), dense(fresh, 8), rtol=1e-12)


def test_curvature_stays_positive_definite_with_negative_curvature(rng):
    curvature, _ = curvature_of_quadratic(rng)
    for _ in range(5):
        s = rng.normal(size=8)
        curvature.update(s, -s, np.zeros((0, 8)))
    assert np.linalg.eigvalsh(dense(curvature, 8)).min() > 0
    before = dense(curvature, 8)
    curvature.update(np.zeros(8), np.ones(8), np.zeros((0, 8)))
    np.testing.assert_array_equal(dense(curvature, 8), before)


def test_curvature_is_that_of_the_lagrangian_for_any_multipliers(rng):
    """Steps with other multipliers give the same B as if the multipliers had always been these."""
    root = rng.normal(size=(3, 8, 8))
    H = root @ np.swapaxes(root, 1, 2) + np.eye(8)
    y = np.array([3.0, 0.5])
    curvature, alone = Curvature(20), Curvature(20)
    for s in rng.normal(size=(8, 8)):
        curvature.update(s, H[0] @ s, H[1:] @ s)
        curvature.of(rng.normal(size=2))
        alone.update(s, (H[0] + y[0] * H[1] + y[1] * H[2]) @ s, np.zeros((0, 8)))
    np.testing.assert_allclose(dense(curvature, 8, y), dense(alone, 8), rtol=1e-9)


@pytest.mark.parametrize("trial", range(6))
def test_quadratic_program_agrees_with_slsqp(trial):
    """Some constraints are active and some are not, and some unknowns are at bounds of the box."""
    rng = np.random.default_rng(trial)
    curvature, _ = curvature_of_quadratic(rng)
    B, g, J = dense(curvature, 8), rng.normal(size=8), rng.normal(size=(3, 8))
    ends = np.array([-np.inf, 0.2, -0.1]), np.array([-0.3, 0.2, 4.0])
    box = np.full(8, -0.5), np.full(8, 0.6)
    d, y = quadratic_program(curvature.of(NO_MULTIPLIERS), g, J, ends, box, 1e3)
    theirs = minimize(
        lambda d: (g @ d + 0.5 * d @ B @ d, g + B @ d), np.zeros(8), jac=True, method="SLSQP",
        bounds=np.stack(box, axis=1), 
        constraints=[LinearConstraint(J[[k]], ends[0][k], ends[1][k]) for k in range(3)], options={"ftol": 1e-14},
    )  # fmt: skip
    assert theirs.success
    np.testing.assert_allclose(d, theirs.x, atol=1e-5)
    assert np.max(np.maximum(J @ d - ends[1], ends[0] - J @ d)) < 1e-7
    slope = g + B @ d + y @ J
    free = (d > box[0] + 1e-7) & (d < box[1] - 1e-7)
    np.testing.assert_allclose(slope[free], 0.0, atol=1e-5)


def test_infeasible_quadratic_program_minimises_the_violation():
    d, _ = quadratic_program(
        LowRank(1.0), np.zeros(2), np.array([[1.0, 1.0]]), (np.array([5.0]), np.array([5.0])),
        (np.full(2, -1.0), np.full(2, 1.0)), 1e3,
    )  # fmt: skip
    np.testing.assert_allclose(d, 1.0, atol=1e-6)


def test_20_000_unknowns(tmp_path, rng):
    n = 20_000
    aim, w = rng.normal(size=n), rng.normal(size=n)
    outcome, _ = solve(tmp_path, Sqp(max_iterations=60), Nearest(aim, w, -300.0))
    projection = aim - w * max(0.0, w @ aim + 300.0) / (w @ w)
    assert outcome.status == "converged"
    np.testing.assert_allclose(outcome.x, projection, atol=1e-3)


class InOtherUnits(Confined):
    """The same problem with objective and constraints in other units."""

    def __init__(self, f_unit, c_unit):
        super().__init__()
        self.f_unit, self.c_unit = f_unit, c_unit
        self.c_low, self.c_high = c_unit * self.c_low, c_unit * self.c_high

    def values_and_constraints(self, x):
        f, c = super().values_and_constraints(x)
        return self.f_unit * f, self.c_unit * c

    def gradients_and_constraints(self, x):
        f, g, c, J = super().gradients_and_constraints(x)
        return self.f_unit * f, self.f_unit * g, self.c_unit * c, self.c_unit * J


@pytest.mark.parametrize("feasibility_first", [True, False])
@pytest.mark.parametrize(("f_unit", "c_unit"), [(1e3, 1.0), (1e-3, 1.0), (1.0, 1e3), (1.0, 1e-3), (1e6, 1.0)])
def test_result_does_not_depend_on_units(f_unit, c_unit, feasibility_first, tmp_path):
    """The weight of violations is estimated at the start, and increased quickly if it is far too small."""
    tolerances = {"function_tolerance": 1e-8 * f_unit, "constraint_tolerance": 1e-6 * c_unit}
    optimizer = Sqp(max_iterations=60, feasibility_first=feasibility_first, **tolerances)
    known, _ = solve(tmp_path / "known", Sqp(), Confined())
    outcome, _ = solve(tmp_path / "units", optimizer, InOtherUnits(f_unit, c_unit))
    assert outcome.status == "converged", outcome.message
    np.testing.assert_allclose(outcome.x, known.x, atol=1e-3)


@pytest.mark.parametrize("n", [4, 10, 14, 30])
def test_minimum_is_reported_as_converged(n, tmp_path):
    """Rejected trials leave a small radius with a tiny predicted decrease; so is the decrease with the whole radius.

    From 14 unknowns on it seems larger, because of curvature from earlier steps around the valley's bend.
    """

    class Free(InNumbers, Rosenbrock):
        constraint_names = ()
        c_low = c_high = np.zeros(0)

        def values_and_constraints(self, x):
            return self.value(x), np.zeros(0)

        def gradients_and_constraints(self, x):
            return *self.value_and_grad(x), np.zeros(0), np.zeros((0, n))

    outcome, _ = solve(tmp_path, Sqp(max_iterations=300), Free(n))
    assert outcome.status == "converged", outcome.message
    np.testing.assert_allclose(outcome.x, 1.0, atol=1e-2)


def uncorrected(trials, B, here, there, *_):
    return there


EXACT = Sqp(max_iterations=100, constraint_tolerance=1e-8)


def test_second_order_correction_saves_iterations(tmp_path, monkeypatch):
    """Without correction, steps along a curved constraint stay short and end outside."""
    outcome, session = solve(tmp_path / "with", EXACT, OnACircle(seed=2))
    assert outcome.status == "converged", outcome.message
    np.testing.assert_allclose(outcome.x, np.eye(12)[0], atol=1e-3)
    monkeypatch.setattr(sqp, "_corrected", uncorrected)
    without, other = solve(tmp_path / "without", EXACT, OnACircle(seed=2))
    assert outcome.iterations < 0.7 * without.iterations
    assert session.computed < 0.7 * other.computed  # an iteration with a correction has more trials


def test_no_correction_if_it_cannot_help(tmp_path, monkeypatch):
    """Rejected steps along linear constraints miss them only by rounding errors, and cost no second rollout."""
    missed = []

    def noting(trials, B, here, there, *others):
        missed.append(there.c - np.clip(there.c, trials.problem.c_low, trials.problem.c_high))
        return corrected(trials, B, here, there, *others)

    corrected = sqp._corrected
    monkeypatch.setattr(sqp, "_corrected", noting)
    _, session = solve(tmp_path / "with", EXACT, Confined(30, radius=2.5))
    assert missed
    assert np.abs(missed).max() < 1e-8
    monkeypatch.setattr(sqp, "_corrected", uncorrected)
    _, other = solve(tmp_path / "without", EXACT, Confined(30, radius=2.5))
    assert session.computed == other.computed


def test_only_rejected_steps_are_corrected(tmp_path, monkeypatch):
    """A step whose decrease is a little too small is taken, and the radius shrinks."""
    accepted, corrected = [], sqp._corrected

    def noting(trials, B, here, there, room, radius, rho, enough):
        ends = trials.problem.c_low, trials.problem.c_high
        accepted.append(here.merit(rho, *ends) - there.merit(rho, *ends) > enough)
        return corrected(trials, B, here, there, room, radius, rho, enough)

    monkeypatch.setattr(sqp, "_corrected", noting)
    solve(tmp_path, EXACT, OnACircle(50, seed=1))
    assert accepted
    assert not any(accepted)


def test_corrected_steps_are_the_same_after_kills_at_every_evaluation(tmp_path, monkeypatch):
    taken, corrected = [], sqp._corrected

    def noting(trials, B, here, there, *others):
        other = corrected(trials, B, here, there, *others)
        taken.append(other is not there)
        return other

    monkeypatch.setattr(sqp, "_corrected", noting)
    whole, session = solve(tmp_path / "whole", EXACT, OnACircle())
    assert any(taken)
    for _ in range(session.computed - 1):
        with pytest.raises(Killed):
            solve(tmp_path / "cut", EXACT, OnACircle(fuse=1))
    cut, last = solve(tmp_path / "cut", EXACT, OnACircle(fuse=1))
    assert last.computed == 1
    assert bits(cut) == bits(whole)
    assert history_rows(tmp_path / "cut") == history_rows(tmp_path / "whole")


def test_curvature_uses_one_trial_of_a_corrected_step(tmp_path, monkeypatch):
    """Both trials are almost the same; using both would push older steps out of the memory."""
    pairs, steps = [], []
    corrected, update = sqp._corrected, sqp.Curvature.update

    def noting(trials, B, here, there, *others):
        other = corrected(trials, B, here, there, *others)
        if other is not there:
            pairs.append((there.x - here.x, other.x - here.x))
        return other

    monkeypatch.setattr(sqp, "_corrected", noting)
    monkeypatch.setattr(sqp.Curvature, "update", lambda self, s, *changes: steps.append(s) or update(self, s, *changes))
    solve(tmp_path, EXACT, OnACircle())
    assert pairs
    for trial, taken in pairs:
        assert any(np.array_equal(s, taken) for s in steps)
        assert not any(np.allclose(s, trial, rtol=0.0, atol=1e-13) for s in steps)
