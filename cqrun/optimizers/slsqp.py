"""SLSQP: sequential quadratic programming, for objectives under constraints with up to 5,000 unknowns."""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.optimizers.base import Problem, Status
from cqrun.optimizers.constrained import ConstrainedTrials
from cqrun.optimizers.two_searches import Feasible, TwoSearches
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin
from cqrun.units import format_bytes

MOST_UNKNOWNS = 5000
"""With more unknowns, n x n matrices and n^3 operations per step are too expensive."""

WORKSPACE = 8.5
"""Workspace of Kraft's quadratic program in n x n matrices: n (n + 1) / 2 + 8 n^2 + O(n) numbers (scipy, NLopt)."""


@plugin("optimizer", "slsqp")
class Slsqp(TwoSearches):
    """SLSQP: the step d minimises g.d + d.B d / 2 under linearised constraints, then a line search; B by BFGS.

    It first searches for a point that meets the constraints, without the objective, and then minimises the objective,
    as in ChainQueen. Memory grows with the square of the number of unknowns.
    D. Kraft: A software package for sequential quadratic programming, DFVLR-FB 88-28 (1988); scipy's implementation.
    """

    def require(self, problem: Problem) -> None:
        """Raise UsageError also for a problem that is too large or has more equalities than unknowns."""
        super().require(problem)
        require_size(problem, self.name)
        require_room(problem, self.name)

    def search(
        self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array, *, feasibility: bool
    ) -> tuple[Status, str]:
        """Run scipy's SLSQP once; in the search for feasibility f is 0, and `Feasible` is raised on success."""
        from scipy.optimize import Bounds, minimize

        def accept(x: Array) -> None:
            trials.accept(x)
            if feasibility and trials.violated(x) <= self.constraint_tolerance:
                raise Feasible

        result = minimize(
            (lambda x: 0.0) if feasibility else (lambda x: trials.values(x)[0]),
            x,
            jac=(lambda x: np.zeros(len(x))) if feasibility else (lambda x: trials.gradients(x)["g"].copy()),
            method="SLSQP",
            bounds=Bounds(lower, upper),
            constraints=halves(trials),
            callback=accept,
            options={"maxiter": 2**31 - 1, "ftol": self.function_tolerance},  # the callback counts, over all restarts
        )
        return ("converged" if result.status == 0 else "stalled"), f"SLSQP: {result.message}"


def halves(trials: ConstrainedTrials) -> list[dict[str, Any]]:
    """Return the constraints for scipy's SLSQP: c - c_low >= 0, c_high - c >= 0, and c - c_low = 0."""
    low, high = trials.problem.c_low, trials.problem.c_high
    equal = low == high
    sides = [("eq", equal, 1.0, low), ("ineq", ~equal & np.isfinite(low), 1.0, low)]
    sides += [("ineq", ~equal & np.isfinite(high), -1.0, high)]
    return [
        {
            "type": kind,
            "fun": lambda x, rows=rows, sign=sign, end=end: sign * (trials.values(x)[1] - end)[rows],
            "jac": lambda x, rows=rows, sign=sign: sign * trials.gradients(x)["J"][rows],
        }
        for kind, rows, sign, end in sides
        if rows.any()
    ]


def require_size(problem: Problem, name: str, matrices: float = WORKSPACE) -> None:
    """Raise UsageError for a problem that is too large for a dense quadratic program."""
    n = len(problem.start)
    if n > MOST_UNKNOWNS:
        needed = format_bytes(8 * int(matrices * n * n))
        raise UsageError(
            f"{name} needs {needed} for matrices of {n:,} x {n:,} unknowns, and time as their cube; "
            f"beyond {MOST_UNKNOWNS:,} use sqp or augmented_lagrangian, or fewer unknowns (`per: group`, `per: field`)"
        )


def require_room(problem: Any, name: str) -> None:
    """Raise UsageError for more equalities than unknowns, with which these methods end at once."""
    equalities, n = int(np.sum(problem.c_low == problem.c_high)), len(problem.start)
    if equalities > n:
        unknowns = "unknown" if n == 1 else "unknowns"
        raise UsageError(
            f"{name} takes no more equalities than unknowns, here {equalities} with {n} {unknowns}: use sqp, or "
            "`at_least` and `at_most` instead of `equals`"
        )
