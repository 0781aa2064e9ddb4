"""Searches under constraints that go back, repeat themselves or end at an infeasible point, and their messages."""

from __future__ import annotations

import re

import numpy as np
import pytest
from toy_problems import Confined, InNumbers, solve

from cqrun.errors import UsageError
from cqrun.optimizers.constrained import ConstrainedTrials, ReplayedConstrained
from cqrun.optimizers.nlopt import Nlopt
from cqrun.optimizers.slsqp import Slsqp
from cqrun.optimizers.sqp import Sqp
from cqrun.optimizers.trust_constr import TrustConstr


class Overdetermined(Confined):
    """The valley of two unknowns with three equalities."""

    constraint_names = ("a", "b", "c")

    def __init__(self):
        super().__init__(n=2)
        self.c_low = self.c_high = np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize("kind", [Slsqp(), TrustConstr(), Nlopt(), Nlopt(algorithm="auglag")])
def test_more_equalities_than_unknowns_are_an_error(kind):
    """These methods would end before their first evaluation."""
    with pytest.raises(UsageError, match=f"{kind.name} takes no more equalities than unknowns, here 3 with 2 unknowns"):
        kind.require(Overdetermined())


class Incompatible(InNumbers):
    """A problem with one unknown and two constraints that no value meets both; found by chance."""

    term_names = ()
    stochastic = False
    n_batches = 1
    constraint_names = ("above", "on")

    def __init__(self):
        self.start, self.lower, self.upper = np.array([0.7763356027377813]), np.array([-1.0]), np.array([2.0])
        self.A = np.array([0.5706560135801596, 1.3826081419979863])
        self.Q = np.array([0.07165612740859849, -0.45580987045490456])
        self.c_low = np.array([-0.07022033568558819, -1.916230725399971])
        self.c_high = np.array([np.inf, -1.916230725399971])

    def term_values(self):
        return np.zeros(0)

    def values_and_constraints(self, x):
        return 0.5 * float(x @ x), self.A * x + self.Q * x**2

    def gradients_and_constraints(self, x):
        f, c = self.values_and_constraints(x)
        return f, x.copy(), c, (self.A + 2.0 * self.Q * x)[:, None]


def test_line_search_that_repeats_itself_ends(tmp_path, monkeypatch):
    values, calls = ConstrainedTrials.values, 0

    def counted(self, x):
        nonlocal calls
        calls += 1
        assert calls < 20_000, "the search does not end, and checks neither the limit nor a request to stop"
        return values(self, x)

    monkeypatch.setattr(ConstrainedTrials, "values", counted)
    outcome, _ = solve(tmp_path, Nlopt(max_iterations=100), Incompatible())
    assert outcome.status == "infeasible"
    assert "repeats evaluations without end" in outcome.message


class TwoValleys(InNumbers):
    """A constraint that is met in one of two valleys; the start is in the other one, whose minimum is higher."""

    term_names = ()
    stochastic = False
    n_batches = 1
    constraint_names = ("deep",)

    def __init__(self):
        self.start, self.lower, self.upper = np.array([0.9, 0.2]), np.full(2, -2.0), np.full(2, 2.0)
        self.c_low, self.c_high = np.array([-np.inf]), np.array([-1.2])

    def term_values(self):
        return np.zeros(0)

    def values_and_constraints(self, x):
        t = x[0]
        return float(x @ x), np.array([t**4 - 2.0 * t**2 + 0.3 * t + x[1] ** 2])

    def gradients_and_constraints(self, x):
        f, c = self.values_and_constraints(x)
        t = x[0]
        return f, 2.0 * x, c, np.array([[4.0 * t**3 - 4.0 * t + 0.3, 2.0 * x[1]]])


@pytest.mark.parametrize("first", [True, False], ids=["feasibility first", "one search"])
@pytest.mark.parametrize("kind", [Sqp, Slsqp, Nlopt])
def test_message_for_a_local_minimum_of_the_violation(tmp_path, kind, first):
    assert TwoValleys().values_and_constraints(np.array([-1.04, 0.0]))[1] < -1.2
    outcome, _ = solve(tmp_path, kind(feasibility_first=first), TwoValleys())
    assert outcome.status == "infeasible"
    assert re.match(r"not met[^:]*; another start or solver may help: constraint 'deep' is -0.705", outcome.message)


def test_sqp_distinguishes_local_minima_of_the_violation_from_stalled_searches(tmp_path):
    outcome, _ = solve(tmp_path, Sqp(), TwoValleys())
    assert outcome.message.startswith("not met where the search converged; another start or solver may help: ")


class Returning(ReplayedConstrained):
    """Accepts a point, another one, and the first one again."""

    max_iterations: int = 9

    def attempt(self, trials, x, lower, upper):
        for point in (x, 0.5 * x, x):
            trials.accept(point)
        assert trials.values(x)[0] == trials.problem.values_and_constraints(x)[0]
        return "converged", ""


def test_solver_may_go_back_to_an_earlier_point(tmp_path):
    """NLopt's SLSQP does so after a failed line search."""
    outcome, session = solve(tmp_path, Returning(), Confined())
    assert outcome.iterations == 3
    assert session.computed == 2


class Raised(Confined):
    """The valley with a large constant added, compared with which changes of the loss are small."""

    def values_and_constraints(self, x):
        f, c = super().values_and_constraints(x)
        return f + 1e5, c

    def gradients_and_constraints(self, x):
        f, *others = super().gradients_and_constraints(x)
        return f + 1e5, *others


@pytest.mark.parametrize("algorithm", ["slsqp", "auglag"])
def test_function_tolerance_is_absolute(tmp_path, algorithm):
    method = Nlopt(algorithm=algorithm, max_iterations=2000, function_tolerance=1e-6)
    low, _ = solve(tmp_path / "low", method, Confined())
    high, _ = solve(tmp_path / "high", method, Raised())
    assert high.loss - 1e5 == pytest.approx(low.loss, abs=1e-3)
