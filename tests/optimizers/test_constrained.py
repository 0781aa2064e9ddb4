"""Optimizers under constraints: minima, history, and messages if the constraints cannot be met."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from toy_problems import Confined, Nearest, Rosenbrock, run_folder, solve

from cqrun.errors import MissingExtra, UsageError
from cqrun.optimizers.augmented_lagrangian import AugmentedLagrangian
from cqrun.optimizers.base import TrialFailed
from cqrun.optimizers.constrained import Kkt, _signed_least_squares, kkt, most_violated, ranked, verdict, violation
from cqrun.optimizers.nlopt import Nlopt
from cqrun.optimizers.slsqp import MOST_UNKNOWNS, Slsqp
from cqrun.optimizers.sqp import Sqp
from cqrun.optimizers.trust_constr import TrustConstr
from cqrun.store.history import read_history

AIM, W = np.array([3.0, -1.0, 0.5]), np.array([1.0, 2.0, 2.0])
METHODS = {
    "slsqp": Slsqp(max_iterations=200),
    "slsqp, one search": Slsqp(max_iterations=200, feasibility_first=False),
    "sqp": Sqp(max_iterations=200),
    "trust_constr": TrustConstr(max_iterations=400),
    "nlopt slsqp": Nlopt(max_iterations=200),
    "nlopt auglag": Nlopt(algorithm="auglag", max_iterations=2000, feasibility_first=False),
    "nlopt auglag, feasibility first": Nlopt(algorithm="auglag", max_iterations=2000),
    "augmented_lagrangian": AugmentedLagrangian(max_iterations=900, learning_rate=0.05, gradient_tolerance=1e-5),
    "augmented_lagrangian without restoration": AugmentedLagrangian(
        max_iterations=900, learning_rate=0.05, gradient_tolerance=1e-5, restoring=0
    ),
}


@pytest.fixture(params=METHODS)
def method(request):
    return METHODS[request.param]


class Twice(Confined):
    """The problem with every constraint duplicated."""

    constraint_names = ("a", "b", "c", "d")

    def __init__(self):
        super().__init__()
        self.c_low, self.c_high = np.tile(self.c_low, 2), np.tile(self.c_high, 2)

    def values_and_constraints(self, x):
        f, c = super().values_and_constraints(x)
        return f, np.tile(c, 2)

    def gradients_and_constraints(self, x):
        f, g, c, J = super().gradients_and_constraints(x)
        return f, g, np.tile(c, 2), np.vstack([J, J])


def test_duplicate_constraints_do_not_change_the_result(tmp_path):
    once, _ = solve(tmp_path / "once", Sqp(), Confined())
    twice, _ = solve(tmp_path / "twice", Sqp(), Twice())
    assert (once.status, twice.status) == ("converged", "converged")
    np.testing.assert_allclose(twice.x, once.x, atol=1e-4)


# --- violation and KKT ------------------------------------------------------------------------------------------


def test_violation_is_the_distance_from_the_nearer_end():
    low, high = np.array([-np.inf, 1.0, 2.0]), np.array([1.0, 3.0, 2.0])
    np.testing.assert_array_equal(violation(np.array([1.5, 0.5, 2.0]), low, high), [0.5, 0.5, 0.0])
    np.testing.assert_array_equal(violation(np.array([-9.0, 4.0, 1.0]), low, high), [0.0, 1.0, 1.0])
    assert most_violated(np.zeros(0), np.zeros(0), np.zeros(0)) == 0.0


def at(problem, x, tolerance=1e-9) -> Kkt:
    _, g, c, J = problem.gradients_and_constraints(x)
    return kkt(problem, x, g, c, J, tolerance)


def test_multiplier_at_a_projection():
    problem = Nearest(AIM, W, -1.0)
    y = (W @ AIM + 1.0) / (W @ W)
    optimality = at(problem, AIM - y * W)
    assert optimality.multipliers == pytest.approx([y])
    assert optimality.residual < 1e-12


def test_inactive_constraint_has_no_multiplier():
    optimality = at(Nearest(AIM, W, 10.0), AIM)
    assert optimality.multipliers == pytest.approx([0.0])
    assert optimality.residual == 0.0


def test_constraint_near_its_end_has_a_multiplier():
    """A minimum is recognised before its constraint is exact; a constraint far from its end has no multiplier."""
    problem = Nearest(AIM, W, -1.0)
    y, away = (W @ AIM + 1.0) / (W @ W), W / (W @ W)
    at_minimum = AIM - y * W
    near = at(problem, at_minimum - 4e-6 * away, 1e-6)
    assert near.multipliers == pytest.approx([y], rel=1e-5)
    assert near.residual == pytest.approx(4e-6 * y, rel=0.1)
    far = at(problem, at_minimum - 0.01 * away, 1e-6)
    assert far.multipliers == [0.0]
    assert far.residual == pytest.approx(2.0 * y, rel=0.01)


def test_trust_constr_reports_its_own_multipliers(tmp_path):
    """Its points are farther from all ends than the tolerance."""
    problem = Nearest(AIM, W, -1.0)
    solve(tmp_path, METHODS["trust_constr"], problem)
    rows = read_history(run_folder(tmp_path) / "history.csv")
    assert rows["multiplier:plane"][-1] == pytest.approx((W @ AIM + 1.0) / (W @ W), rel=1e-3)
    assert rows["kkt"][-1] < 1e-4


def test_multiplier_has_the_right_sign():
    """At c_high where f falls towards the inside: this is no minimum, and no negative multiplier hides it."""
    problem = Nearest(AIM, W, 10.0)
    x = AIM + W * (10.0 - W @ AIM) / (W @ W)
    optimality = at(problem, x)
    assert optimality.multipliers == pytest.approx([0.0])
    assert optimality.residual == pytest.approx(np.max(np.abs(x - AIM)))


def test_multipliers_of_more_constraints_than_unknowns():
    """Found by chance: scipy multiplies infinity by zero here, and did not converge for columns of 1e-4 and 1e-6."""
    A = np.array([[-2.69711810e-04, 1.61547019e-06, 6.15693912e-05], [4.66684255e-04, -1.79905882e-06, 0.0]])
    b = np.array([-21.18180707, 5.52386469])
    y = _signed_least_squares(A, b, (np.array([0.0, -np.inf, 0.0]), np.full(3, np.inf)))
    slope = A.T @ (A @ y - b) / np.linalg.norm(A, axis=0)
    assert slope[1] == pytest.approx(0.0, abs=1e-4)
    assert (y[[0, 2]] >= 0.0).all()
    assert (slope[[0, 2]] >= -1e-4).all()
    assert (y * slope)[[0, 2]] == pytest.approx([0.0, 0.0], abs=1e-4)


def test_active_bounds_of_the_box_do_not_count_in_the_residual():
    problem = Nearest(AIM, W, 10.0, box=2.0)
    x = np.clip(AIM, -2.0, 2.0)
    assert at(problem, x).residual == 0.0
    assert at(problem, np.array([1.9, -1.0, 0.5])).residual == pytest.approx(1.1)


# --- minima ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("most", [-1.0, 10.0], ids=["active", "inactive"])
def test_ends_at_the_projection(tmp_path, method, most):
    problem = Nearest(AIM, W, most)
    outcome, _ = solve(tmp_path, method, problem)
    projection = AIM - W * max(0.0, W @ AIM - most) / (W @ W)
    assert outcome.status == "converged"
    assert outcome.x == pytest.approx(projection, abs=1e-4)
    assert W @ outcome.x <= most + method.constraint_tolerance


def test_ends_at_a_kkt_point_of_a_valley(tmp_path, method):
    problem = Confined()
    outcome, _ = solve(tmp_path, method, problem)
    _, g, c, J = problem.gradients_and_constraints(outcome.x)
    assert outcome.status == "converged"
    assert most_violated(c, problem.c_low, problem.c_high) <= method.constraint_tolerance
    assert kkt(problem, outcome.x, g, c, J, method.constraint_tolerance).residual < 1e-2


def test_history_has_violation_residual_and_multipliers(tmp_path, method):
    problem = Confined()
    outcome, _ = solve(tmp_path, method, problem)
    rows = read_history(run_folder(tmp_path) / "history.csv")
    columns = ["violation", "kkt", "constraint:sum", "constraint:ball", "multiplier:sum", "multiplier:ball"]
    assert list(rows)[4:10] == columns
    assert rows["violation"][0] == pytest.approx(abs(problem.start.sum() - 1.0))
    assert min(rows["violation"]) <= method.constraint_tolerance
    assert rows["kkt"][-1] < rows["kkt"][0]
    assert len(rows["loss"]) == outcome.iterations + 1


def test_feasibility_comes_first(tmp_path):
    problem = Nearest([9.0, 9.0, 9.0], W, -20.0)
    solve(tmp_path, METHODS["slsqp"], problem)
    rows = read_history(run_folder(tmp_path) / "history.csv")
    assert rows["violation"][0] == 20.0
    # one step to the plane by the shortest way, then along it
    first = -20.0 * W / (W @ W)
    assert [rows[f"value:{name}"][1] for name in ("a", "b[0]", "b[1]")] == pytest.approx(list(2.0 * first))
    assert max(rows["violation"][1:]) <= 1e-6


# --- no minimum ------------------------------------------------------------------------------------------


def test_infeasible_problem_ends_at_the_smallest_violation(tmp_path, method):
    outcome, _ = solve(tmp_path, method, Confined(n=3, radius=100.0, total=10.0))
    assert outcome.status == "infeasible"
    assert outcome.x.sum() == pytest.approx(6.0, abs=1e-3)
    assert "constraint 'sum' is 6, wanted 10: violated by 4, the least that was found" in outcome.message
    assert "at bounds: [] below, [0, 1, 2] above" in outcome.message


class Stuck(Confined):
    """The valley with a third constraint, which is constant."""

    constraint_names = ("sum", "ball", "stuck")

    def __init__(self):
        super().__init__()
        self.c_low, self.c_high = np.append(self.c_low, -np.inf), np.append(self.c_high, 0.0)

    @property
    def scales(self):
        return np.array([1.0, 1.0, 10.0])

    def values_and_constraints(self, x):
        f, c = super().values_and_constraints(x)
        return f, np.append(c, 7.0)

    def gradients_and_constraints(self, x):
        f, g, c, J = super().gradients_and_constraints(x)
        return f, g, np.append(c, 7.0), np.vstack([J, np.zeros_like(x)])


def test_other_constraints_are_met_beside_a_constant_one(tmp_path, method):
    """The best point meets the others; the history is in the constraints' own units."""
    problem = Stuck()
    outcome, _ = solve(tmp_path, method, problem)
    assert outcome.status == "infeasible"
    assert "constraint 'stuck' is 70, wanted at most 0" in outcome.message
    assert "no unknown has an effect on stuck" in outcome.message
    rows = read_history(run_folder(tmp_path) / "history.csv")
    assert set(rows["constraint:stuck"]) == {70.0}
    _, c = problem.values_and_constraints(outcome.x)
    others = violation(c, problem.c_low, problem.c_high)[:2]
    recorded = np.array([rows["constraint:sum"], rows["constraint:ball"]]) - problem.c_high[:2, None]
    assert others.sum() <= (np.abs(recorded[0]) + np.maximum(recorded[1], 0.0)).min() + 2e-6
    if not isinstance(method, Slsqp) and getattr(method, "algorithm", "") != "slsqp":  # Kraft's method ends earlier
        assert others.max() <= method.constraint_tolerance
        assert "violated less" not in outcome.message


def test_violations_below_the_tolerance_do_not_affect_the_order():
    assert ranked(np.array([2e-7, 0.0]), 3.0, 1e-6) == (0.0, 0.0, 3.0)
    assert ranked(np.array([0.5, 0.25]), 9.0, 1e-6) < ranked(np.array([0.5, 0.25 + 3e-6]), 3.0, 1e-6)
    assert ranked(np.array([0.5, 0.25]), 3.0, 1e-6) < ranked(np.array([0.5 - 4e-7, 0.25 + 3e-7]), 9.0, 1e-6)
    assert ranked(np.zeros(0), 3.0, 0.0) == (0.0, 0.0, 3.0)


def test_verdict_is_in_the_unit_of_the_constraint_and_names_the_others():
    problem = Confined(n=2, radius=1.0, total=3.0)
    problem.__class__ = type("Scaled", (Confined,), {"scales": np.array([0.01, 2.0])})
    text = verdict(problem, np.array([2.0, 0.5]), np.array([2.5, 4.25]), 1e-6)
    assert text == (
        "constraint 'ball' is 8.5, wanted at most 2: violated by 6.5 (3.25 of its scale), the least that was found; "
        "sum is violated less; at bounds: [] below, [0] above"
    )


def test_augmented_lagrangian_converges_at_a_feasible_point(tmp_path):
    """On the way across the limit the gradient is small too, after feasible points."""
    problem = Nearest([1.0, 0.0], [1.0, 0.0], 0.0)
    problem.start = np.array([-0.1, 1.5])
    method = AugmentedLagrangian(max_iterations=900, learning_rate=0.1, gradient_tolerance=0.1)
    outcome, _ = solve(tmp_path, method, problem)
    assert outcome.status == "converged"
    assert outcome.x == pytest.approx([0.0, 0.0], abs=0.11)


class FailingAt(Confined):
    """The valley, with some evaluations that blow up."""

    def __init__(self, blown):
        super().__init__()
        self.blown = blown

    def _evaluate(self, x):
        answer = super()._evaluate(x)
        if self.evaluations in self.blown:
            raise TrialFailed("left the grid", body="beam", particle=7, time=0.25, values="")
        return answer


@pytest.mark.parametrize("blown", [(), (5,), (5, 9), (5, 9, 13)])
def test_restoration_steps_are_whole_after_failed_trials(tmp_path, blown):
    """A quarter of such a step would remove at most a quarter of the violation, and would never count as helpful."""
    outcome, _ = solve(tmp_path, AugmentedLagrangian(max_iterations=300, learning_rate=0.05), FailingAt(blown))
    assert outcome.status == "iteration_limit"
    assert outcome.x.sum() == pytest.approx(1.0, abs=1e-6)


def test_sqp_shortens_its_step_after_a_failed_trial(tmp_path):
    """Every fourth trial fails, and it still converges to the same minimum, without one of the three restarts."""

    class Fragile(Confined):
        def _evaluate(self, x):
            self.wall = -9.0 if self.evaluations % 4 == 3 else np.inf
            return super()._evaluate(x)

    whole, _ = solve(tmp_path / "whole", Sqp(), Confined())
    problem = Fragile()
    outcome, _ = solve(tmp_path / "fragile", Sqp(), problem)
    assert outcome.status == "converged"
    assert problem.evaluations > 20
    np.testing.assert_allclose(outcome.x, whole.x, atol=1e-4)


def test_iteration_limit_before_feasibility_is_infeasible(tmp_path):
    outcome, _ = solve(tmp_path, Slsqp(max_iterations=1), Confined(n=6, radius=0.5, total=1.0))
    assert outcome.status == "infeasible"
    assert outcome.message.startswith("not met yet, more iterations may help: constraint")
    assert "(1 iterations, the limit)" in outcome.message


def test_error_for_too_many_unknowns_states_the_memory():
    problem = Nearest(np.zeros(MOST_UNKNOWNS + 1), np.ones(MOST_UNKNOWNS + 1), 1.0)
    with pytest.raises(UsageError, match=r"slsqp needs 1.58 GiB .* 5,001 x 5,001 unknowns.*augmented_lagrangian"):
        Slsqp().require(problem)
    with pytest.raises(UsageError, match=r"trust_constr needs 191 MiB"):
        TrustConstr().require(problem)


def test_fit_to_data_is_an_error(method):
    with pytest.raises(UsageError, match="to fit data take least_squares"):
        method.require(Rosenbrock())


def test_mma_takes_no_equality():
    with pytest.raises(UsageError, match="nlopt's mma takes no equalities"):
        Nlopt(algorithm="mma").require(Confined())


def test_iteration_limit_ends_a_nested_method(tmp_path):
    outcome, _ = solve(tmp_path, Nlopt(algorithm="auglag", max_iterations=4, feasibility_first=False), Confined())
    assert outcome.iterations == 4
    assert "(4 iterations, the limit)" in outcome.message


def test_mma_searches_for_feasibility_first(tmp_path):
    problem = Nearest([9.0, 9.0, 9.0], W, -20.0)
    outcome, _ = solve(tmp_path, Nlopt(algorithm="mma", max_iterations=200), problem)
    assert outcome.status == "converged"
    assert outcome.x == pytest.approx(np.full(3, 9.0) - W * (W @ np.full(3, 9.0) + 20.0) / (W @ W), abs=3e-3)


def test_mma_ends_at_the_projection(tmp_path):
    outcome, _ = solve(tmp_path, Nlopt(algorithm="mma", max_iterations=300), Nearest(AIM, W, -1.0))
    assert outcome.x == pytest.approx(AIM - W * (W @ AIM + 1.0) / (W @ W), abs=3e-3)


@pytest.mark.parametrize("algorithm", ["slsqp", "mma", "auglag"])
def test_search_that_cannot_leave_its_start_ends(tmp_path, algorithm):
    """The bounds exclude all points that meet the constraint; iterations at the start count too."""
    problem = Nearest(AIM, W, -1.0)
    problem.lower = problem.start.copy()
    outcome, _ = solve(tmp_path, Nlopt(algorithm=algorithm, max_iterations=30), problem)
    assert outcome.status == "infeasible"
    assert "constraint 'plane' is 0, wanted at most -1" in outcome.message


def test_error_names_the_missing_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "nlopt", None)
    with pytest.raises(MissingExtra, match=r"'nlopt', which is not installed: pip install 'cqrun\[nlopt\]'"):
        solve(tmp_path, Nlopt(), Confined())
