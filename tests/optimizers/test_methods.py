"""Each optimizer finds optima, stays within bounds, and explains failures."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError
from threadpoolctl import threadpool_info, threadpool_limits
from toy_problems import Rosenbrock, history_rows, run_folder, solve

from cqrun.errors import UsageError
from cqrun.optimizers.adam import Adam
from cqrun.optimizers.base import Optimizer, one_blas_thread
from cqrun.optimizers.first_order import HALVINGS
from cqrun.optimizers.lbfgs import Lbfgs
from cqrun.optimizers.least_squares import LeastSquares
from cqrun.optimizers.replayed import half_box
from cqrun.optimizers.sgd import Sgd
from cqrun.plugin.contract import Plugin
from cqrun.plugin.registry import plugins

SCIPY = [LeastSquares(max_iterations=60), Lbfgs(max_iterations=300)]
DESCENT = [Adam(max_iterations=40, learning_rate=0.1), Sgd(max_iterations=40, learning_rate=0.01)]


def name_of(method: Plugin) -> str:
    return method.name


def test_registry_contains_all_optimizers():
    registered = plugins("optimizer")
    assert set(registered) == {
        "adam", "augmented_lagrangian", "cma_es", "lbfgs", "least_squares", "nlopt", "sgd", "slsqp", "sqp",
        "trust_constr",
    }  # fmt: skip
    assert all(issubclass(cls, Optimizer) and cls.__doc__ for cls in registered.values())
    assert all(cls().max_iterations >= 1 for cls in registered.values())


@pytest.mark.parametrize(
    ("method", "field"),
    [("lbfgs", "memory"), ("lbfgs", "line_search_steps"), ("sqp", "memory"), ("cma_es", "population")],
)
def test_counts_that_a_method_allocates_have_a_bound(method, field):
    with pytest.raises(ValueError, match=rf"{field}\n.*must be at most 1(0)?000, is 1000000"):
        plugins("optimizer")[method].model_validate({field: 10**6})


def test_registry_does_not_import_scipy():
    import subprocess
    import sys

    code = (
        "import sys; from cqrun.plugin.registry import plugins; plugins('optimizer');"
        "import cqrun.store.run, cqrun.store.session, cqrun.store.trajectory;"
        "assert not {'scipy', 'numba', 'h5py', 'matplotlib', 'cma'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("method", SCIPY, ids=name_of)
def test_scipy_converges_to_the_minimum_of_the_valley(tmp_path, method):
    outcome, _ = solve(tmp_path, method, Rosenbrock())
    assert outcome.status == "converged"
    np.testing.assert_allclose(outcome.x, 1.0, atol=1e-5)
    assert outcome.loss < 1e-12


@pytest.mark.parametrize("method", SCIPY, ids=name_of)
def test_scipy_respects_bounds(tmp_path, method):
    problem = Rosenbrock(bound=0.9)
    problem.start = np.clip(problem.start, -0.8, 0.8)
    outcome, _ = solve(tmp_path, method, problem)
    assert outcome.status == "converged"
    assert (np.abs(outcome.x) <= 0.9).all()
    assert outcome.x[0] == pytest.approx(0.9, abs=1e-3)


class Bowl(Rosenbrock):
    """A quadratic whose minimum lies beyond the upper bound of its second unknown."""

    term_names = ()
    goal = np.array([0.3, 2.0])

    def __init__(self):
        super().__init__(n=2)
        self.start, self.upper, self.n_batches = np.zeros(2), np.array([np.inf, 1.0]), 1

    def term_values(self):
        return np.zeros(0)

    def value_and_grad(self, x, batch=None):
        return 0.5 * np.sum((x - self.goal) ** 2), x - self.goal


@pytest.mark.parametrize(
    "method",
    [
        Adam(max_iterations=2000, learning_rate=0.05, decay=0.01, gradient_tolerance=1e-6),
        Sgd(max_iterations=500, learning_rate=0.2, momentum=0.3, gradient_tolerance=1e-6),
    ],
    ids=name_of,
)
def test_descent_converges_on_the_projected_gradient(tmp_path, method):
    outcome, _ = solve(tmp_path, method, Bowl())
    assert outcome.status == "converged"
    np.testing.assert_allclose(outcome.x, [0.3, 1.0], atol=1e-5)
    again, _ = solve(tmp_path, method, Bowl())  # a converged run does not change
    assert again.x.tobytes() == outcome.x.tobytes()
    assert again.iterations == outcome.iterations


def test_adam_agrees_with_the_paper(tmp_path):
    """Three steps agree with algorithm 1."""
    method = Adam(max_iterations=3, learning_rate=0.1, beta1=0.8, beta2=0.95)
    x, m, v = Bowl().start, 0.0, 0.0
    for k in range(1, 4):
        g = x - Bowl.goal
        m, v = 0.8 * m + 0.2 * g, 0.95 * v + 0.05 * g * g
        x = x - 0.1 * (m / (1 - 0.8**k)) / (np.sqrt(v / (1 - 0.95**k)) + 1e-8)
    outcome, _ = solve(tmp_path, method, Bowl())
    np.testing.assert_allclose(outcome.x, x, rtol=1e-14)


def test_sgd_agrees_with_polyaks_momentum(tmp_path):
    method = Sgd(max_iterations=3, learning_rate=0.05, momentum=0.9)
    x, u = Bowl().start, 0.0
    for _ in range(3):
        u = 0.9 * u + (x - Bowl.goal)
        x = x - 0.05 * u
    outcome, _ = solve(tmp_path, method, Bowl())
    np.testing.assert_allclose(outcome.x, x, rtol=1e-14)


def test_gradient_is_clipped_by_norm_and_by_entry(tmp_path):
    grad = Bowl().start - Bowl.goal  # (-0.3, -2)
    for options, clipped in (
        ({"clip": 0.5}, 0.5 * grad / np.linalg.norm(grad)),
        ({"clip": 9.0}, grad),
        ({"clip_entries": 1.0}, np.array([-0.3, -1.0])),
        ({"clip_entries": 0.3, "clip": 0.1}, np.full(2, -0.1 / np.sqrt(2.0))),
    ):
        problem = Bowl()
        problem.upper = np.full(2, np.inf)
        out = tmp_path / "-".join(options) / str(options.get("clip"))
        outcome, _ = solve(out, Sgd(max_iterations=1, learning_rate=0.1, **options), problem)
        np.testing.assert_allclose(outcome.x, problem.start - 0.1 * clipped, rtol=1e-14)


def test_history_has_the_unclipped_gradient(tmp_path):
    solve(tmp_path / "whole", Sgd(max_iterations=1), Bowl())
    solve(tmp_path / "clipped", Sgd(max_iterations=1, clip=0.1, clip_entries=0.2, mask=0.5), Bowl())
    first = [history_rows(tmp_path / name)[1] for name in ("whole", "clipped")]
    assert first[0] == first[1]


def test_masked_entries_do_not_change(tmp_path):
    """About a tenth of the entries is masked, different ones in each step, and the same ones for the same seed."""

    class Slope(Bowl):
        steps: list[np.ndarray]

        def __init__(self):
            super().__init__()
            self.start, self.lower, self.upper = np.zeros(500), np.full(500, -np.inf), np.full(500, np.inf)
            self.steps = []

        def value_and_grad(self, x, batch=None):
            self.steps.append(x.copy())
            return float(np.sum(x)), np.ones(500)

    method = Sgd(max_iterations=20, learning_rate=0.5, mask=0.1)
    first, repeated, other = Slope(), Slope(), Slope()
    for problem, name, seed in ((first, "first", 3), (repeated, "repeated", 3), (other, "other", 4)):
        solve(tmp_path / name, method, problem, seed=seed)
    changes = np.diff(first.steps, axis=0)
    assert set(np.unique(changes)) == {-0.5, 0.0}
    masked = changes == 0.0
    assert 0.08 < masked.mean() < 0.12
    assert not (masked[0] == masked[1]).all()
    np.testing.assert_array_equal(first.steps, repeated.steps)
    assert not np.array_equal(first.steps, other.steps)


def test_mini_batches_use_every_part_once_per_epoch(tmp_path):
    class Watching(Rosenbrock):
        batches: list[tuple[int, ...]] = []  # noqa: RUF012  one list for the test's only problem

        def value_and_grad(self, x, batch=None):
            self.batches.append(batch)
            return super().value_and_grad(x, batch)

    problem = Watching()
    solve(tmp_path, Sgd(max_iterations=7, learning_rate=0.001, batch_size=4), problem)
    sizes = [len(batch) for batch in problem.batches]
    assert sizes == [4, 4, 2, 4, 4, 2, 4, 4]  # 10 parts
    first_epoch = sorted(part for batch in problem.batches[:3] for part in batch)
    assert first_epoch == list(range(10))


@pytest.mark.parametrize("method", [*SCIPY, *DESCENT], ids=name_of)
def test_failed_start_ends_the_run(tmp_path, method):
    outcome, _ = solve(tmp_path, method, Rosenbrock(wall=-5.0))
    assert outcome.status == "failed"
    for part in ("body 'beam'", "particle 7", "t = 0.25 s", "trial values: a = -1.2"):
        assert part in outcome.message


@pytest.mark.parametrize("method", SCIPY, ids=name_of)
def test_failed_trials_shrink_the_box(tmp_path, method):
    problem = Rosenbrock(wall=0.5)  # (1, ..., 1) cannot be reached
    outcome, session = solve(tmp_path, method, problem)
    assert outcome.status in ("failed", "stalled")
    assert outcome.x[0] <= 0.5
    assert outcome.loss < Rosenbrock().value_and_grad(problem.start)[0]
    log = (run_folder(tmp_path) / "log.txt").read_text()
    assert "failed trial: body 'beam', particle 7" in log
    assert "restart 1 of 3" in log
    assert log.count("failed trial") <= 4
    assert session.computed == problem.evaluations


def test_minimum_at_the_shrunken_box_is_reported_as_stalled(tmp_path):
    class Cliff(Bowl):
        """Fails where x[0] is above 0.25, so a smaller box avoids failures."""

        def value_and_grad(self, x, batch=None):
            self._evaluate(np.array([1.0 if x[0] > 0.25 else 0.0, 0.0]))
            return super().value_and_grad(x)

    problem = Cliff()
    problem.wall = 0.5
    outcome, _ = solve(tmp_path, Lbfgs(), problem)
    assert outcome.status == "stalled"
    assert "box" in outcome.message
    assert outcome.x[0] <= 0.25


@pytest.mark.parametrize("method", DESCENT, ids=name_of)
def test_descent_halves_the_step_five_times_then_fails(tmp_path, method):
    class Trap(Rosenbrock):
        """Blows up everywhere except at the start."""

        def _evaluate(self, x):
            self.wall = np.inf if np.array_equal(x, self.start) else -9.0
            return super()._evaluate(x)

    problem = Trap()
    outcome, _ = solve(tmp_path, method, problem)
    assert outcome.status == "failed"
    assert "after 5 halvings" in outcome.message
    assert problem.evaluations == 1 + 6
    assert outcome.x.tobytes() == problem.start.tobytes()
    assert "step times 0.03125" in (run_folder(tmp_path) / "log.txt").read_text()


@pytest.mark.parametrize("method", DESCENT, ids=name_of)
def test_descent_continues_with_half_the_step(tmp_path, method):
    class Once(Rosenbrock):
        def _evaluate(self, x):
            self.wall = -9.0 if self.evaluations == 3 else np.inf
            return super()._evaluate(x)

    problem = Once()
    outcome, _ = solve(tmp_path, method, problem)
    assert outcome.status == "iteration_limit"
    assert problem.evaluations == method.max_iterations + 2
    assert "back to iteration 2, step times 0.5" in (run_folder(tmp_path) / "log.txt").read_text()


@pytest.mark.parametrize("method", DESCENT, ids=name_of)
def test_separate_failures_are_not_counted_together(tmp_path, method):
    class Thrice(Rosenbrock):
        def _evaluate(self, x):
            self.wall = -9.0 if self.evaluations % 4 == 3 else np.inf
            return super()._evaluate(x)

    problem = Thrice()
    outcome, _ = solve(tmp_path, method, problem)
    assert outcome.status == "iteration_limit"
    assert problem.evaluations - (method.max_iterations + 1) > 2 * HALVINGS


@pytest.mark.parametrize("method", [*SCIPY, *DESCENT], ids=name_of)
def test_loss_that_is_not_finite_is_a_failed_trial(tmp_path, method):
    class Broken(Rosenbrock):
        def _evaluate(self, x):
            r, jacobian = super()._evaluate(x)
            return r + np.nan, jacobian

    outcome, _ = solve(tmp_path, method, Broken())
    assert outcome.status == "failed"
    assert "not finite; trial values: x = [-1.2" in outcome.message


def test_half_box_is_half_as_wide_around_the_point():
    x, lower, upper = np.array([0.0, 1.0, 3.0]), np.array([-1.0, 1.0, -np.inf]), np.array([2.0, 5.0, 4.0])
    down, up = half_box(x, lower, upper, reach=8.0)
    np.testing.assert_array_equal(down, [-0.5, 1.0, -1.0])
    np.testing.assert_array_equal(up, [1.0, 3.0, 3.5])


@pytest.mark.parametrize(
    "options",
    [
        {"max_iterations": 0},
        {"learning_rate": -1.0},
        {"beta1": 1.0},
        {"step": 1.0},
        {"clip": 0.0},
        {"clip_entries": -1.0},
        {"mask": 1.0},
    ],
)
def test_invalid_options_are_errors(options):
    with pytest.raises(ValidationError):
        Adam(**options)


def test_mini_batch_larger_than_the_data_is_an_error(tmp_path):
    with pytest.raises(UsageError, match=r"batch_size is 11, .* falls into 10 parts.*at most 10"):
        solve(tmp_path, Sgd(batch_size=11), Rosenbrock())
    assert solve(tmp_path / "all", Sgd(batch_size=10, max_iterations=1), Rosenbrock())[0].iterations == 1


class Drawn(Rosenbrock):
    """A problem with new data in every iteration, which records the requested draws."""

    stochastic = True

    def __init__(self):
        super().__init__()
        self.batches = []

    def value_and_grad(self, x, batch=None):
        self.batches.append(batch)
        return super().value_and_grad(x)


@pytest.mark.parametrize("method", SCIPY, ids=name_of)
def test_changing_objective_is_an_error_for_scipy(tmp_path, method):
    with pytest.raises(UsageError, match=rf"draws fresh goals.*{method.name}.*use adam or sgd, or fix"):
        solve(tmp_path, method, Drawn())


@pytest.mark.parametrize("method", DESCENT, ids=name_of)
def test_descent_requests_a_new_draw_in_each_iteration(tmp_path, method):
    problem = Drawn()
    outcome, _ = solve(tmp_path, method.model_copy(update={"max_iterations": 4}), problem)
    assert problem.batches == [(k,) for k in range(5)]
    assert outcome.loss == problem.value(outcome.x)  # the last point: losses of different draws cannot be compared
    with pytest.raises(UsageError, match="batch_size takes parts of a fixed set"):
        solve(tmp_path / "parts", method.model_copy(update={"batch_size": 2}), problem)


def test_blas_limit_ends_with_the_last_of_two_overlapping_contexts():
    def threads():
        return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

    with threadpool_limits(2, user_api="blas"):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert set(threads()) == {1}
        second.__exit__(None, None, None)
        assert set(threads()) == {2}
