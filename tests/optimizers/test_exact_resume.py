"""A run that was killed and resumed, or extended, is bit-for-bit identical to one that was never stopped."""

from __future__ import annotations

import numpy as np
import pytest
from toy_problems import Killed, Rosenbrock, bits, history_rows, problem_for, run_folder, solve

from cqrun.optimizers.adam import Adam
from cqrun.optimizers.augmented_lagrangian import AugmentedLagrangian
from cqrun.optimizers.cma_es import CmaEs
from cqrun.optimizers.lbfgs import Lbfgs
from cqrun.optimizers.least_squares import LeastSquares
from cqrun.optimizers.nlopt import Nlopt
from cqrun.optimizers.sgd import Sgd
from cqrun.optimizers.slsqp import Slsqp
from cqrun.optimizers.sqp import Sqp
from cqrun.optimizers.trust_constr import TrustConstr

METHODS = {
    "cma_es": CmaEs(max_iterations=25, population=5),
    "least_squares": LeastSquares(max_iterations=12),
    "lbfgs": Lbfgs(max_iterations=25),
    "adam": Adam(max_iterations=25, learning_rate=0.05),
    "adam_batches": Adam(max_iterations=25, learning_rate=0.05, batch_size=3),
    "adam_clipped": Adam(max_iterations=25, learning_rate=0.05, batch_size=3, clip=2.0, clip_entries=1.0, mask=0.2),
    "slsqp": Slsqp(max_iterations=12),
    "sqp": Sqp(max_iterations=12),
    "nlopt": Nlopt(max_iterations=12),
    "trust_constr": TrustConstr(max_iterations=12),
    "augmented_lagrangian": AugmentedLagrangian(max_iterations=25, inner=4),
    "augmented_lagrangian without restoration": AugmentedLagrangian(max_iterations=25, inner=4, restoring=0),
    "sgd": Sgd(max_iterations=25, learning_rate=0.01, momentum=0.5, batch_size=4, decay=0.01),
}


@pytest.fixture(params=METHODS)
def method(request):
    return METHODS[request.param]


def solve_with_kills(out, method, make_problem, fuses):
    """Kill the run in the middle of an evaluation as often as there are fuses, then let it finish."""
    kills = 0
    for fuse in fuses:
        try:
            return solve(out, method, make_problem(fuse=int(fuse)))[0], kills
        except Killed:
            kills += 1
    return solve(out, method, make_problem())[0], kills


@pytest.mark.parametrize("wall", [np.inf, 0.2], ids=["open", "with failed trials"])
def test_killed_in_the_middle_of_evaluations(tmp_path, rng, method, wall):
    def make_problem(fuse=None):
        return problem_for(method, fuse=fuse, wall=wall)

    whole, _ = solve(tmp_path / "whole", method, make_problem())
    for trial in range(2):
        out = tmp_path / f"cut{trial}"
        cut, kills = solve_with_kills(out, method, make_problem, rng.integers(0, 7, 8))
        assert kills > 1
        assert bits(cut) == bits(whole)
        assert history_rows(out) == history_rows(tmp_path / "whole")


@pytest.mark.parametrize(
    ("name", "when"),
    [(name, "report") for name in METHODS] + [(name, "save") for name in ("adam", "adam_clipped", "sgd")],
)
def test_killed_between_history_and_state(tmp_path, name, when):
    method = METHODS[name]
    whole, _ = solve(tmp_path / "whole", method, problem_for(method))

    def sabotage(session):
        act, calls = getattr(session, when), 0

        def die_at_third(*args):
            nonlocal calls
            calls += 1
            if calls == 3:
                raise Killed
            act(*args)

        setattr(session, when, die_at_third)

    with pytest.raises(Killed):
        solve(tmp_path / "cut", method, problem_for(method), sabotage=sabotage)
    cut, _ = solve(tmp_path / "cut", method, problem_for(method))
    assert bits(cut) == bits(whole)
    assert history_rows(tmp_path / "cut") == history_rows(tmp_path / "whole")


def test_extended_run_is_identical_to_a_longer_one(tmp_path, method):
    longer = method.model_copy(update={"max_iterations": method.max_iterations})
    shorter = method.model_copy(update={"max_iterations": 4})
    whole, _ = solve(tmp_path / "whole", longer, problem_for(method))
    first, _ = solve(tmp_path / "cut", shorter, problem_for(method))
    assert first.status in ("iteration_limit", "infeasible")
    assert first.iterations == 4
    extended, _ = solve(tmp_path / "cut", longer, problem_for(method))
    assert whole.iterations > 4
    assert bits(extended) == bits(whole)
    assert history_rows(tmp_path / "cut") == history_rows(tmp_path / "whole")


def test_stopped_and_resumed(tmp_path, method):
    whole, _ = solve(tmp_path / "whole", method, problem_for(method))
    problem = problem_for(method)
    stopped, _ = solve(tmp_path / "cut", method, problem, stop=lambda: problem.evaluations >= 6)
    assert stopped.status == "stopped"
    assert 0 < problem.evaluations <= 6 + (method.population if method.name == "cma_es" else 1)
    cut, _ = solve(tmp_path / "cut", method, problem_for(method))
    assert bits(cut) == bits(whole)


@pytest.mark.parametrize("name", ["least_squares", "lbfgs", "slsqp", "sqp", "trust_constr", "nlopt"])
def test_replay_computes_nothing_twice(tmp_path, name):
    problem = problem_for(METHODS[name])
    _, session = solve(tmp_path, METHODS[name], problem)
    again = problem_for(METHODS[name])
    _, replayed = solve(tmp_path, METHODS[name], again)
    assert session.computed == problem.evaluations
    assert (replayed.replayed, replayed.computed, again.evaluations) == (problem.evaluations, 0, 0)


def test_replay_of_cma_es_computes_no_generation_twice(tmp_path):
    problem, again = Rosenbrock(), Rosenbrock()
    outcome, session = solve(tmp_path, METHODS["cma_es"], problem)
    _, replayed = solve(tmp_path, METHODS["cma_es"], again)
    assert (outcome.iterations, problem.evaluations) == (25, 1 + 25 * 5)
    assert (session.computed, replayed.replayed, replayed.computed, again.evaluations) == (26, 26, 0, 0)


@pytest.mark.parametrize("name", ["adam_clipped", "sgd"])
def test_damaged_newest_state_falls_back_to_the_previous_one(tmp_path, name):
    whole, _ = solve(tmp_path / "whole", METHODS[name], Rosenbrock())
    with pytest.raises(Killed):
        solve(tmp_path / "cut", METHODS[name], Rosenbrock(fuse=9))
    newest = run_folder(tmp_path / "cut") / "evals.1.npz"  # 9 states: the odd generation
    newest.write_bytes(newest.read_bytes()[:200])
    problem = Rosenbrock()
    cut, _ = solve(tmp_path / "cut", METHODS[name], problem)
    assert problem.evaluations == whole.iterations + 1 - 8
    assert bits(cut) == bits(whole)
    assert history_rows(tmp_path / "cut") == history_rows(tmp_path / "whole")


@pytest.mark.parametrize("name", ["sgd", "adam_clipped", "cma_es"])
def test_results_depend_on_the_seed(tmp_path, name):
    method = METHODS[name]
    first, _ = solve(tmp_path / "first", method, Rosenbrock(), seed=1)
    second, _ = solve(tmp_path / "second", method, Rosenbrock(), seed=2)
    assert bits(first) != bits(second)


def test_history_has_its_columns_and_units(tmp_path):
    from cqrun.store.history import read_history

    outcome, _ = solve(tmp_path, METHODS["lbfgs"], Rosenbrock())
    rows = read_history(run_folder(tmp_path) / "history.csv")
    assert list(rows)[:6] == ["iteration", "loss", "valley", "slope", "grad:a", "grad:b"]
    assert rows["iteration"] == list(range(outcome.iterations + 1))
    assert rows["loss"][-1] == outcome.loss
    assert rows["value:a"][-1] == 2.0 * outcome.x[0]
    assert rows["value:b[4]"][-1] == 2.0 * outcome.x[5]
    valley_and_slope = np.add(rows["valley"], rows["slope"])
    np.testing.assert_allclose(valley_and_slope, rows["loss"], rtol=1e-13)
