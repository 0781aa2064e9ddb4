"""Searches under constraints that come back, go round in circles or end where nothing is met, and what they say."""

from __future__ import annotations

import numpy as np
import pytest
from toy_problems import Confined, solve

from cqrun.errors import UsageError
from cqrun.optimizers.constrained import ReplayedConstrained
from cqrun.optimizers.nlopt import Nlopt
from cqrun.optimizers.slsqp import Slsqp


class Overdetermined(Confined):
    """The valley of two unknowns with three equalities."""

    constraint_names = ("a", "b", "c")

    def __init__(self):
        super().__init__(n=2)
        self.c_low = self.c_high = np.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize("kind", [Slsqp(), Nlopt(), Nlopt(algorithm="auglag")], ids=["slsqp", "nlopt", "auglag"])
def test_more_equalities_than_unknowns_are_refused(kind):
    """These methods give up before their first evaluation."""
    with pytest.raises(UsageError, match=f"{kind.name} takes no more equalities than unknowns, here 3 with 2 unknowns"):
        kind.require(Overdetermined())


class Returning(ReplayedConstrained):
    """Accepts a point, another, and the first again."""

    max_iterations: int = 9

    def attempt(self, trials, x, lower, upper):
        for point in (x, 0.5 * x, x):
            trials.accept(point)
        assert trials.values(x)[0] == trials.problem.values_and_constraints(x)[0]
        return "converged", ""


def test_a_solver_may_come_back_to_the_point_before_last(tmp_path):
    """NLopt's SLSQP does, after a line search that led nowhere."""
    outcome, session = solve(tmp_path, Returning(), Confined())
    assert outcome.iterations == 3
    assert session.computed == 2
