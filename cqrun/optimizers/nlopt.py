"""NLopt's methods for constraints: SLSQP, as ChainQueen used it, MMA and an augmented Lagrangian (extra `nlopt`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from pydantic import Field

from cqrun.errors import MissingExtra, UsageError
from cqrun.optimizers.base import Problem, Status
from cqrun.optimizers.constrained import ConstrainedTrials
from cqrun.optimizers.slsqp import require_room, require_size
from cqrun.optimizers.two_searches import Feasible, TwoSearches
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

CONVERGED = (1, 2, 3, 4)
"""NLopt's results that mean a minimum: success, and its three tolerances."""

PATIENCE = 500
"""Calls in a row that ask for nothing but what is known, after which a search only goes round in circles."""


class Circling(Exception):
    """Leaves a search that goes round in circles, where no limit on iterations and no wish to stop would reach it."""


@plugin("optimizer", "nlopt")
class Nlopt(TwoSearches):
    """NLopt's SLSQP, MMA, or augmented Lagrangian over L-BFGS; an iteration is an evaluation with gradients.

    MMA takes inequalities only, and any number of unknowns (K. Svanberg: A class of globally convergent optimization
    methods based on conservative convex separable approximations, SIAM J. Optim. 12 (2002)).
    S. G. Johnson: The NLopt nonlinear-optimization package, github.com/stevengj/nlopt.
    """

    algorithm: Literal["slsqp", "mma", "auglag"] = Field("slsqp", description="which of its methods")

    def require(self, problem: Problem) -> None:
        """Refuse, beside what the base refuses, what is too large, or has equalities that a method cannot have.

        Raises:
            MissingExtra: the library `nlopt` is not installed. UsageError: as said.
        """
        library()
        super().require(problem)
        if self.algorithm == "slsqp":
            require_size(problem, f"{self.name} ({self.algorithm})")
        c_low, c_high = problem.c_low, problem.c_high  # type: ignore[attr-defined]
        if self.algorithm == "mma" and np.any(c_low == c_high):
            raise UsageError("nlopt's mma takes no equalities: use slsqp or auglag, or `at_least` and `at_most`")
        require_room(problem, self.name)

    def search(
        self, trials: ConstrainedTrials, x: Array, lower: Array, upper: Array, *, feasibility: bool
    ) -> tuple[Status, str]:
        """Run NLopt once; in search of feasibility f counts as 0, and `Feasible` is raised on success."""
        nlopt, begun, calls = library(), list[bool](), Calls(trials)

        def objective(x: Array, grad: Array) -> float:
            here = x.copy()  # NLopt's own memory, which changes
            if grad.size:
                grad[:] = 0.0 if feasibility else trials.gradients(here)["g"]
                if begun:  # the first is where the search begins; that it stays there counts, or no limit would end it
                    trials.accept(here)
                begun.append(True)
                if feasibility and trials.violated(here) <= self.constraint_tolerance:
                    raise Feasible
            return 0.0 if feasibility else trials.values(here)[0]

        method = self._made(nlopt, len(x))
        if not feasibility:  # a constant would be converged at once
            method.set_ftol_abs(self.function_tolerance)
        method.set_lower_bounds(lower)
        method.set_upper_bounds(upper)
        method.set_min_objective(calls.kept(objective))
        _constrain(method, trials, 0.1 * self.constraint_tolerance, calls.kept)
        try:
            method.optimize(np.clip(x, lower, upper))
        except Exception as error:  # its own classes differ from version to version
            if calls.raised is None and isinstance(error, nlopt.RoundoffLimited):
                return "converged", "NLopt: as far as rounding lets it come"
            if calls.raised is None:
                return "stalled", f"NLopt: {str(error) or 'failure'}"
        if isinstance(calls.raised, Circling):
            return "stalled", "NLopt: asks again and again for what it has been told"
        if calls.raised is not None:
            raise calls.raised
        code = int(method.last_optimize_result())
        return ("converged" if code in CONVERGED else "stalled"), f"NLopt: {nlopt_result(nlopt, code)}"

    def _made(self, nlopt: Any, n: int) -> Any:
        if self.algorithm == "auglag":
            inner = nlopt.opt(nlopt.LD_LBFGS, n)
            inner.set_ftol_abs(self.function_tolerance)
            inner.set_maxeval(20)
            method = nlopt.opt(nlopt.AUGLAG, n)
            method.set_local_optimizer(inner)
        else:
            method = nlopt.opt({"slsqp": nlopt.LD_SLSQP, "mma": nlopt.LD_MMA}[self.algorithm], n)
        return method


class Calls:
    """NLopt's calls: the first error is kept, as a method inside a method loses it, and circles are left."""

    def __init__(self, trials: ConstrainedTrials) -> None:
        self.trials = trials
        self.raised: BaseException | None = None
        self._asked, self._idle = trials.asked, 0

    def kept(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that does the same, and is watched."""

        def call(*args: Any) -> Any:
            self._idle = self._idle + 1 if self.trials.asked == self._asked else 0
            self._asked = self.trials.asked
            try:
                if self._idle > PATIENCE:
                    raise Circling
                return function(*args)
            except BaseException as error:
                self.raised = self.raised or error
                raise

        return call


def _constrain(
    method: Any, trials: ConstrainedTrials, tolerance: float, keeping: Callable[[Callable[..., Any]], Any]
) -> None:
    """Give NLopt the constraints: c_low - c <= 0, c - c_high <= 0, and c - c_low = 0."""
    low, high = trials.problem.c_low, trials.problem.c_high
    equal = low == high
    sides = [(method.add_equality_mconstraint, equal, 1.0, low)]
    sides += [(method.add_inequality_mconstraint, ~equal & np.isfinite(low), -1.0, low)]
    sides += [(method.add_inequality_mconstraint, ~equal & np.isfinite(high), 1.0, high)]
    for add, rows, sign, end in sides:
        if not rows.any():
            continue

        def constraint(result: Array, x: Array, grad: Array, rows: Any = rows, sign: Any = sign, end: Any = end) -> Any:
            here = x.copy()
            if grad.size:
                grad[:] = sign * trials.gradients(here)["J"][rows]
            result[:] = sign * (trials.values(here)[1] - end)[rows]

        add(keeping(constraint), np.full(int(rows.sum()), tolerance))


def nlopt_result(nlopt: Any, code: int) -> str:
    """Return what a result is called."""
    names = ("SUCCESS", "STOPVAL_REACHED", "FTOL_REACHED", "XTOL_REACHED", "MAXEVAL_REACHED", "MAXTIME_REACHED")
    return {getattr(nlopt, name): name.replace("_", " ").lower() for name in names}.get(code, f"result {code}")


def library() -> Any:
    """Return the module `nlopt`; MissingExtra where it is not installed."""
    try:
        import nlopt  # type: ignore[import-untyped]
    except ImportError:
        raise MissingExtra(
            "the optimizer nlopt needs the package 'nlopt', which is not installed: pip install 'cqrun[nlopt]'"
        ) from None
    return nlopt
