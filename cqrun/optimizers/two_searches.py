"""Feasibility first, then the objective, as in ChainQueen: base of the solvers by quadratic programs."""

from __future__ import annotations

import contextlib
from abc import abstractmethod

from pydantic import Field

from cqrun.optimizers.base import Status
from cqrun.optimizers.constrained import ConstrainedTrials, ReplayedConstrained
from cqrun.plugin.contract import Array


class Feasible(Exception):
    """Ends the search for a feasible point."""


class TwoSearches(ReplayedConstrained):
    """Base of solvers that first search for a feasible point, and then minimise the objective."""

    max_iterations: int = Field(100, ge=1, description="maximum number of iterations, both searches together")
    function_tolerance: float = Field(
        1e-8, gt=0, description="converged when an iteration changes the loss by less and the constraints are met"
    )
    feasibility_first: bool = Field(True, description="whether to meet the constraints first, without the objective")

    @abstractmethod
    def search(
        self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array, *, feasibility: bool
    ) -> tuple[Status, str]:
        """Minimise once from x in a box; in the search for feasibility f is 0, and `Feasible` is raised on success.

        If that search returns `converged`, no small step reduces the violation. For nonlinear constraints this may be
        only a local minimum of the violation.
        """

    def attempt(self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array) -> tuple[Status, str]:
        """Search for a feasible point, then minimise the objective."""
        if self.feasibility_first and trials.violated(x) > self.constraint_tolerance:
            ended: tuple[Status, str] = "converged", ""
            with contextlib.suppress(Feasible):
                ended = self.search(trials, x, lower, upper, feasibility=True)
            assert trials.best_x is not None
            x = trials.best_x
            if trials.violated(x) > self.constraint_tolerance:
                return ended
        return self.search(trials, x, lower, upper, feasibility=False)
