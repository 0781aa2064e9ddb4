"""CMA-ES: finds optima from values only, runs trials side by side, and continues after failed trials."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from pydantic import ValidationError
from toy_problems import Rosenbrock, bits, history_rows, run_folder, solve

from cqrun.errors import MissingExtra
from cqrun.optimizers.base import TrialFailed
from cqrun.optimizers.cma_es import CmaEs
from cqrun.store.history import read_history


class Values(Rosenbrock):
    """Rosenbrock's valley without a gradient."""

    def value(self, x, batch=None):
        return Rosenbrock.value_and_grad(self, x)[0]

    def value_and_grad(self, x, batch=None):
        raise AssertionError("CMA-ES must not need a gradient")


def test_converges_to_the_minimum_of_the_valley(tmp_path):
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=2000), Values(n=3))
    assert outcome.status == "converged"
    np.testing.assert_allclose(outcome.x, 1.0, atol=1e-4)
    assert "tolfun" in outcome.message


def test_respects_bounds_on_one_side_and_on_both(tmp_path):
    problem = Values(n=3)
    problem.lower, problem.upper = np.array([-2.0, -np.inf, -1.0]), np.array([0.5, np.inf, np.inf])
    trials = []
    problem.values_at = lambda points, batch=None: [trials.append(x.copy()) or problem.value(x) for x in points]
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=400), problem)
    assert (problem.lower <= np.array(trials)).all()
    assert (np.array(trials) <= problem.upper).all()
    assert outcome.x[0] == pytest.approx(0.5, abs=1e-6)


def test_works_with_one_unknown(tmp_path):
    class Parabola(Values):
        term_names = ()

        def value(self, x, batch=None):
            return float((x[0] - 0.25) ** 2)

    outcome, _ = solve(tmp_path, CmaEs(max_iterations=200), Parabola(n=1, bound=2.0))
    assert outcome.x == pytest.approx([0.25], abs=1e-5)


def test_generation_is_one_call_if_the_problem_has_values_at(tmp_path):
    class Together(Values):
        def __init__(self):
            super().__init__()
            self.sizes = []

        def values_at(self, points, batch=None):
            self.sizes.append(len(points))
            return [self.value(x) for x in points]

    method = CmaEs(max_iterations=6, population=7)
    together = Together()
    both = [solve(tmp_path / name, method, problem)[0] for name, problem in (("a", together), ("b", Values()))]
    assert together.sizes == [7] * 6
    assert bits(both[0]) == bits(both[1])


def test_history_has_a_row_for_the_best_trial_of_each_generation(tmp_path):
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=9), Values())
    rows = read_history(run_folder(tmp_path) / "history.csv")
    assert rows["iteration"] == list(range(10))
    assert rows["loss"][0] == Values().value(Values().start)
    assert min(rows["loss"]) == outcome.loss == Values().value(outcome.x)
    assert np.isnan(rows["grad:a"]).all()
    assert np.isnan(rows["valley"]).all()


def test_numpys_global_generator_is_not_changed(tmp_path):
    before = np.random.get_state()[1].copy()  # noqa: NPY002  this state must not change
    first, _ = solve(tmp_path / "first", CmaEs(max_iterations=5), Values())
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    second, _ = solve(tmp_path / "second", CmaEs(max_iterations=5), Values())
    assert bits(first) == bits(second)


def test_failed_trials_rank_last_and_are_logged(tmp_path):
    problem = Values(wall=-0.5)
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=60, sigma=0.5), problem)
    assert outcome.status == "iteration_limit"
    assert outcome.x[0] <= -0.5
    assert outcome.loss < 0.5 * problem.value(problem.start)
    log = (run_folder(tmp_path) / "log.txt").read_text()
    assert "trials failed, such as: body 'beam', particle 7" in log


def test_values_may_be_failures_or_not_finite(tmp_path):
    def broken(points, batch=None):
        return [TrialFailed("left the grid"), np.nan, np.inf, *(Values().value(x) for x in points[3:])]

    problem = Values()
    problem.values_at = broken
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=5, population=8), problem)
    assert outcome.status == "iteration_limit"
    assert np.isfinite(outcome.loss)


def test_failed_start_ends_the_run(tmp_path):
    outcome, _ = solve(tmp_path, CmaEs(), Values(wall=-5.0))
    assert (outcome.status, outcome.iterations) == ("failed", 0)
    for part in ("the start itself fails", "body 'beam'", "particle 7", "trial values: a = -1.2"):
        assert part in outcome.message


class Trap(Values):
    """Blows up everywhere except within `reach` of the start."""

    def __init__(self, reach=0.0):
        super().__init__()
        self.reach = reach

    def _evaluate(self, x):
        self.wall = np.inf if np.abs(x - self.start).max() <= self.reach else -99.0
        return super()._evaluate(x)


def test_generations_without_a_good_trial_halve_sigma_then_fail(tmp_path):
    problem = Trap()
    outcome, _ = solve(tmp_path, CmaEs(population=4), problem)
    assert outcome.status == "failed"
    assert "after 5 halvings of sigma" in outcome.message
    assert problem.evaluations == 1 + 4 * 6
    assert outcome.x.tobytes() == problem.start.tobytes()


def test_run_continues_if_half_of_sigma_is_enough(tmp_path):
    outcome, _ = solve(tmp_path, CmaEs(population=4, max_iterations=3, sigma=1.0), Trap(reach=0.3))
    assert outcome.status == "iteration_limit"
    assert "sigma halved" in (run_folder(tmp_path) / "log.txt").read_text()


def test_stochastic_objective_is_drawn_for_every_generation(tmp_path):
    class Drawn(Values):
        stochastic = True

        def __init__(self):
            super().__init__()
            self.batches = []

        def value(self, x, batch=None):
            self.batches.append(batch)
            return super().value(x)

    problem = Drawn()
    solve(tmp_path, CmaEs(max_iterations=3, population=4), problem)
    assert problem.batches == [(k,) for k in (0, *[1] * 4, *[2] * 4, *[3] * 4)]


def test_error_names_the_missing_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(MissingExtra, match=r"cma_es needs the package 'cma'.*pip install 'cqrun\[evo\]'"):
        solve(tmp_path, CmaEs(), Values())


def test_library_writes_no_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    solve(tmp_path / "out", CmaEs(max_iterations=3), Values())
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert len(history_rows(tmp_path / "out")) == 1 + 4


@pytest.mark.parametrize("options", [{"population": 3}, {"sigma": 0.0}, {"max_iterations": 0}, {"learning_rate": 0.1}])
def test_invalid_options_are_errors(options):
    with pytest.raises(ValidationError):
        CmaEs(**options)
