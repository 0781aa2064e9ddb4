"""Feasibility first, then the objective, as ChainQueen did: what its solvers by quadratic programs share."""

from __future__ import annotations

import contextlib
from abc import abstractmethod

from pydantic import Field

from cqrun.optimizers.base import Status
from cqrun.optimizers.constrained import ConstrainedTrials, ReplayedConstrained
from cqrun.plugin.contract import Array


class Feasible(Exception):
    """Leaves the search for a point that violates nothing."""


class TwoSearches(ReplayedConstrained):
    """Base of solvers that first look for a point that meets the constraints, and then lower the objective."""

    max_iterations: int = Field(100, ge=1, description="iterations at most, both searches together")
    function_tolerance: float = Field(
        1e-8, gt=0, description="converged when an iteration changes the loss by less and the constraints are met"
    )
    feasibility_first: bool = Field(True, description="whether the constraints are met before the objective counts")

    @abstractmethod
    def search(
        self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array, *, feasibility: bool
    ) -> tuple[Status, str]:
        """Minimise once from x in a box; where only feasibility is sought f counts as 0, and success is `Feasible`.

        Returned, `converged` then means that no small step lowers the violation: of curved constraints a local minimum.
        """

    def attempt(self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array) -> tuple[Status, str]:
        """Search for a point that meets the constraints, then for a lower objective."""
        if self.feasibility_first and trials.violated(x) > self.constraint_tolerance:
            ended: tuple[Status, str] = "converged", ""
            with contextlib.suppress(Feasible):
                ended = self.search(trials, x, lower, upper, feasibility=True)
            assert trials.best_x is not None
            x = trials.best_x
            if trials.violated(x) > self.constraint_tolerance:
                return ended
        return self.search(trials, x, lower, upper, feasibility=False)
