"""CMA-ES: finds optima from values alone, side by side where it may, and lives with failed trials."""

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
    """Rosenbrock's valley that has no gradient to give."""

    def value(self, x, batch=None):
        return Rosenbrock.value_and_grad(self, x)[0]

    def value_and_grad(self, x, batch=None):
        raise AssertionError("CMA-ES asks for no gradient")


def test_it_converges_to_the_valley_floor(tmp_path):
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=2000), Values(n=3))
    assert outcome.status == "converged"
    np.testing.assert_allclose(outcome.x, 1.0, atol=1e-4)
    assert "tolfun" in outcome.message


def test_it_respects_bounds_on_one_side_and_on_both(tmp_path):
    problem = Values(n=3)
    problem.lower, problem.upper = np.array([-2.0, -np.inf, -1.0]), np.array([0.5, np.inf, np.inf])
    seen = []
    problem.values_at = lambda points, batch=None: [seen.append(x.copy()) or problem.value(x) for x in points]
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=400), problem)
    assert (problem.lower <= np.array(seen)).all()
    assert (np.array(seen) <= problem.upper).all()
    assert outcome.x[0] == pytest.approx(0.5, abs=1e-6)


def test_one_unknown_is_enough(tmp_path):
    class Parabola(Values):
        term_names = ()

        def value(self, x, batch=None):
            return float((x[0] - 0.25) ** 2)

    outcome, _ = solve(tmp_path, CmaEs(max_iterations=200), Parabola(n=1, bound=2.0))
    assert outcome.x == pytest.approx([0.25], abs=1e-5)


def test_a_generation_is_one_call_where_the_problem_offers_it(tmp_path):
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


def test_a_row_a_generation_of_its_best_trial(tmp_path):
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=9), Values())
    rows = read_history(run_folder(tmp_path) / "history.csv")
    assert rows["iteration"] == list(range(10))
    assert rows["loss"][0] == Values().value(Values().start)
    assert min(rows["loss"]) == outcome.loss == Values().value(outcome.x)
    assert np.isnan(rows["grad:a"]).all()
    assert np.isnan(rows["valley"]).all()


def test_it_leaves_numpys_own_generator_alone(tmp_path):
    before = np.random.get_state()[1].copy()  # noqa: NPY002  the very state that must not be touched
    one, _ = solve(tmp_path / "one", CmaEs(max_iterations=5), Values())
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002
    np.random.seed(1)  # noqa: NPY002
    two, _ = solve(tmp_path / "two", CmaEs(max_iterations=5), Values())
    assert bits(one) == bits(two)


def test_failed_trials_rank_last_and_are_told(tmp_path):
    problem = Values(wall=-0.5)
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=60, sigma=0.5), problem)
    assert outcome.status == "iteration_limit"
    assert outcome.x[0] <= -0.5
    assert outcome.loss < 0.5 * problem.value(problem.start)
    log = (run_folder(tmp_path) / "log.txt").read_text()
    assert "trials failed, such as: body 'beam', particle 7" in log


def test_a_problem_may_answer_with_failures_or_with_what_is_no_number(tmp_path):
    def broken(points, batch=None):
        return [TrialFailed("left the grid"), np.nan, np.inf, *(Values().value(x) for x in points[3:])]

    problem = Values()
    problem.values_at = broken
    outcome, _ = solve(tmp_path, CmaEs(max_iterations=5, population=8), problem)
    assert outcome.status == "iteration_limit"
    assert np.isfinite(outcome.loss)


def test_a_start_that_fails_ends_the_run(tmp_path):
    outcome, _ = solve(tmp_path, CmaEs(), Values(wall=-5.0))
    assert (outcome.status, outcome.iterations) == ("failed", 0)
    for part in ("the start itself fails", "body 'beam'", "particle 7", "trial values: a = -1.2"):
        assert part in outcome.message


class Trap(Values):
    """Blows up everywhere but at the start, or at a distance from it."""

    def __init__(self, reach=0.0):
        super().__init__()
        self.reach = reach

    def _evaluate(self, x):
        self.wall = np.inf if np.abs(x - self.start).max() <= self.reach else -99.0
        return super()._evaluate(x)


def test_generations_that_fail_as_a_whole_halve_sigma_then_fail(tmp_path):
    problem = Trap()
    outcome, _ = solve(tmp_path, CmaEs(population=4), problem)
    assert outcome.status == "failed"
    assert "after 5 halvings of sigma" in outcome.message
    assert problem.evaluations == 1 + 4 * 6
    assert outcome.x.tobytes() == problem.start.tobytes()


def test_half_of_sigma_may_be_enough(tmp_path):
    outcome, _ = solve(tmp_path, CmaEs(population=4, max_iterations=3, sigma=1.0), Trap(reach=0.3))
    assert outcome.status == "iteration_limit"
    assert "sigma halved" in (run_folder(tmp_path) / "log.txt").read_text()


def test_every_generation_has_its_own_draw_of_a_stochastic_objective(tmp_path):
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


def test_its_absence_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(MissingExtra, match=r"cma_es needs the package 'cma'.*pip install 'cqrun\[evo\]'"):
        solve(tmp_path, CmaEs(), Values())


def test_it_writes_no_files_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    solve(tmp_path / "out", CmaEs(max_iterations=3), Values())
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert len(history_rows(tmp_path / "out")) == 1 + 4


@pytest.mark.parametrize("options", [{"population": 3}, {"sigma": 0.0}, {"max_iterations": 0}, {"learning_rate": 0.1}])
def test_options_are_checked(options):
    with pytest.raises(ValidationError):
        CmaEs(**options)
