"""Feasibility first, then the objective, as ChainQueen did: what its solvers by quadratic programs share."""

from __future__ import annotations

import contextlib
from abc import abstractmethod

from pydantic import Field

from cqrun.contract import Array
from cqrun.optimizers.base import Outcome, Problem, Session, Status, refuse_stochastic
from cqrun.optimizers.constrained import ConstrainedOptimizer, ConstrainedTrials, ended, require_constraints
from cqrun.optimizers.replayed import minimise_with_restarts


class Feasible(Exception):
    """Leaves the search for a point that violates nothing."""


class TwoSearches(ConstrainedOptimizer):
    """Base of solvers that first look for a point that meets the constraints, and then lower the objective."""

    max_iterations: int = Field(100, ge=1, description="iterations at most, both searches together")
    function_tolerance: float = Field(
        1e-8, gt=0, description="converged when an iteration changes the loss by less and the constraints are met"
    )
    feasibility_first: bool = Field(True, description="whether the constraints are met before the objective counts")

    def require(self, problem: Problem) -> None:
        """Refuse what has no constraints to ask for, and what changes from iteration to iteration."""
        require_constraints(problem, self.name)
        refuse_stochastic(problem, self)

    @abstractmethod
    def search(
        self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array, *, feasibility: bool
    ) -> tuple[Status, str]:
        """Minimise once from x in a box; where only feasibility is sought f counts as 0, and success is `Feasible`."""

    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise with exact resume through the session's log; UsageError as `require`."""
        self.require(problem)
        import scipy.optimize  # noqa: F401  its BLAS must be loaded before its threads are pinned

        trials = ConstrainedTrials(problem, session, self.max_iterations, self.constraint_tolerance)
        return ended(trials, minimise_with_restarts(self._attempt, trials))

    def _attempt(self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array) -> tuple[Status, str]:
        if self.feasibility_first and trials.violated(x) > self.constraint_tolerance:
            message = ""
            with contextlib.suppress(Feasible):
                _, message = self.search(trials, x, lower, upper, feasibility=True)
            assert trials.best_x is not None
            x = trials.best_x
            if trials.violated(x) > self.constraint_tolerance:
                return "infeasible", message
        return self.search(trials, x, lower, upper, feasibility=False)
