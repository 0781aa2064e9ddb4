"""NLopt's methods for constraints: SLSQP, which ChainQueen used, MMA and an augmented Lagrangian (extra `nlopt`)."""

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
"""Result codes of NLopt that mean a minimum: success, and its three tolerances."""

PATIENCE = 500
"""Number of successive calls without a new evaluation after which a search is ended: it repeats itself."""


class Repeating(Exception):
    """Ends a search that repeats itself, where neither the iteration limit nor a request to stop is checked."""


@plugin("optimizer", "nlopt")
class Nlopt(TwoSearches):
    """NLopt's SLSQP, MMA, or augmented Lagrangian with L-BFGS; an iteration is an evaluation with gradients.

    MMA allows inequalities only, and any number of unknowns (K. Svanberg: A class of globally convergent optimization
    methods based on conservative convex separable approximations, SIAM J. Optim. 12 (2002)).
    S. G. Johnson: The NLopt nonlinear-optimization package, github.com/stevengj/nlopt.
    """

    algorithm: Literal["slsqp", "mma", "auglag"] = Field("slsqp", description="method of NLopt")

    def require(self, problem: Problem) -> None:
        """Check the problem also for its size, and for equalities that the method does not support.

        Raises:
            MissingExtra: the library `nlopt` is not installed. UsageError: the method cannot solve the problem.
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
        """Run NLopt once; in the search for feasibility f is 0, and `Feasible` is raised on success."""
        nlopt, n_gradients, calls = library(), 0, Calls(trials)

        def objective(x: Array, grad: Array) -> float:
            nonlocal n_gradients
            here = x.copy()  # x is NLopt's memory, which changes
            if grad.size:
                grad[:] = 0.0 if feasibility else trials.gradients(here)["g"]
                # the first is the start; staying there counts as an iteration, or no limit would end the search
                if n_gradients:
                    trials.accept(here)
                n_gradients += 1
                if feasibility and trials.violated(here) <= self.constraint_tolerance:
                    raise Feasible
            return 0.0 if feasibility else trials.values(here)[0]

        method = self._method(nlopt, len(x))
        if not feasibility:  # a constant objective would converge at once
            method.set_ftol_abs(self.function_tolerance)
        method.set_lower_bounds(lower)
        method.set_upper_bounds(upper)
        method.set_min_objective(calls.watch(objective))
        _constrain(method, trials, 0.1 * self.constraint_tolerance, calls.watch)
        try:
            method.optimize(np.clip(x, lower, upper))
        except Exception as error:  # its exception classes differ between versions
            if calls.raised is None and isinstance(error, nlopt.RoundoffLimited):
                return "converged", "NLopt: no further progress because of rounding errors"
            if calls.raised is None:
                return "stalled", f"NLopt: {str(error) or 'failure'}"
        if isinstance(calls.raised, Repeating):
            return "stalled", "NLopt: repeats evaluations without end"
        if calls.raised is not None:
            raise calls.raised
        code = int(method.last_optimize_result())
        return ("converged" if code in CONVERGED else "stalled"), f"NLopt: {nlopt_result(nlopt, code)}"

    def _method(self, nlopt: Any, n: int) -> Any:
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
    """Watches NLopt's calls: stores the first error, which nested methods lose, and ends endless repetition."""

    def __init__(self, trials: ConstrainedTrials) -> None:
        self.trials = trials
        self.raised: BaseException | None = None
        self._requests, self._idle = trials.requests, 0

    def watch(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a function to watch its calls."""

        def call(*args: Any) -> Any:
            self._idle = self._idle + 1 if self.trials.requests == self._requests else 0
            self._requests = self.trials.requests
            try:
                if self._idle > PATIENCE:
                    raise Repeating
                return function(*args)
            except BaseException as error:
                self.raised = self.raised or error
                raise

        return call


def _constrain(
    method: Any, trials: ConstrainedTrials, tolerance: float, watch: Callable[[Callable[..., Any]], Any]
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

        add(watch(constraint), np.full(int(rows.sum()), tolerance))


def nlopt_result(nlopt: Any, code: int) -> str:
    """Return the name of a result code."""
    names = ("SUCCESS", "STOPVAL_REACHED", "FTOL_REACHED", "XTOL_REACHED", "MAXEVAL_REACHED", "MAXTIME_REACHED")
    return {getattr(nlopt, name): name.replace("_", " ").lower() for name in names}.get(code, f"result {code}")


def library() -> Any:
    """Return the module `nlopt`; MissingExtra if it is not installed."""
    try:
        import nlopt  # type: ignore[import-untyped]
    except ImportError:
        raise MissingExtra(
            "the optimizer nlopt needs the package 'nlopt', which is not installed: pip install 'cqrun[nlopt]'"
        ) from None
    return nlopt
