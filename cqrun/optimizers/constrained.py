"""Minimisation under constraints: the interface of such problems, violations, and the distance from a minimum.

    minimise f(x)   over   lower <= x <= upper   where   c_low <= c(x) <= c_high

A constraint with equal ends is an equality. Its multiplier y is positive if c_high is active, negative if c_low is, and
zero if neither is. At a minimum two things vanish (Karush, Kuhn and Tucker; J. Nocedal, S. Wright: Numerical
optimization, 2006, section 12.3): the gradient of f + y.c, except where a bound of the box is active; and the product
of each y with the distance s of its constraint from the active end. The KKT residual is the largest component of both.
Its multipliers minimise the Euclidean norm of both, or come from the solver. Only a constraint that is closer to an end
than the square root of the tolerance has a multiplier. This identifies active constraints well before x is at the end
(F. Facchinei, A. Fischer, C. Kanzow: On the accurate identification of active constraints, SIAM J. Optim. 9, 1998).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Protocol

import numpy as np
from pydantic import Field

from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.optimizers.base import Optimizer, Outcome, Problem, Session, require_finite, terms_of
from cqrun.optimizers.replayed import Replayed, Trials, minimise_with_restarts
from cqrun.plugin.contract import Array

VIOLATION, KKT = "violation", "kkt"
AT_BOUND = 1e-6
"""Distance from a bound of the box, in scaled coordinates, at which the bound is active."""

CONSTRAINT, MULTIPLIER = "constraint:", "multiplier:"
"""Prefixes of columns in the history, followed by the name of a constraint."""


class ConstrainedProblem(Problem, Protocol):
    """A `Problem` with m constraints, each in units of its scale.

    Attributes:
        constraint_names: m names.
        c_low, c_high: (m,) limits, may be infinite; equal for an equality.
        scales: (m,) scale of each constraint in its own unit.
    """

    constraint_names: Sequence[str]
    c_low: Array
    c_high: Array
    scales: Array

    def values_and_constraints(self, x: Array) -> tuple[float, Array]:
        """Return f and c (m,)."""

    def gradients_and_constraints(self, x: Array) -> tuple[float, Array, Array, Array]:
        """Return f, its gradient (n,), c (m,) and its Jacobian (m, n)."""

    def lagrangian(self, x: Array, weigh: Callable[[Array], Array]) -> tuple[float, Array, Array]:
        """Return f, c (m,) and the gradient (n,) of f + w.c, where w = weigh(c) is treated as constant."""

    def bounds_in_words(self, below: Array, above: Array) -> str:
        """Describe which unknowns are at a bound, given those at their lower and at their upper one (n,)."""


class ConstrainedOptimizer(Optimizer):
    """Base of the optimizers that support constraints; without constraints they minimise f."""

    constrained: ClassVar[bool] = True
    constraint_tolerance: float = Field(
        1e-6, gt=0, description="a constraint is met when its violation is at most this, in units of its scale"
    )


def report_names(problem: Any) -> list[str]:
    """Return the names of the history's columns for constraints; none if there are no constraints."""
    names = list(getattr(problem, "constraint_names", ()))
    columns = [CONSTRAINT + name for name in names] + [MULTIPLIER + name for name in names]
    return [VIOLATION, KKT, *columns] if names else []


def violation(c: Array, low: Array, high: Array) -> Array:
    """Return the violation of each constraint (m,), 0 if it is met."""
    return np.maximum(0.0, np.maximum(low - c, c - high))


def most_violated(c: Array, low: Array, high: Array) -> float:
    """Return the largest violation, 0 without constraints."""
    return float(np.max(violation(c, low, high), initial=0.0))


def ranked(excess: Array, loss: float, tolerance: float) -> tuple[float, float, float]:
    """Return the key that orders points: largest violation, then the sum of violations above the tolerance, then loss.

    Violations (m,) are rounded up to multiples of the tolerance, so that a constant largest one does not hide the
    others.
    """
    over = excess[excess > tolerance]
    if not len(over):
        return 0.0, 0.0, loss
    return float(np.ceil(over.max() / tolerance)), float(np.ceil(over.sum() / tolerance)), loss


@dataclass(frozen=True)
class Kkt:
    """Multipliers y (m,) and the KKT residual."""

    multipliers: Array
    residual: float


def kkt(problem: ConstrainedProblem, x: Array, g: Array, c: Array, J: Array, tolerance: float) -> Kkt:
    """Return the multipliers at x and the KKT residual.

    Args:
        g, c, J: gradient (n,), constraints (m,) and their Jacobian (m, n) at x.
        tolerance: largest violation of a constraint that is met.
    """
    distance = np.maximum(0.0, np.stack([c - problem.c_low, problem.c_high - c]))  # (2, m), distances from both ends
    near = distance <= np.sqrt(tolerance)
    active = np.flatnonzero(near.any(axis=0))
    below, above = at_bounds(problem, x)
    free = ~below & ~above
    y, s = np.zeros(len(c)), distance.min(axis=0)
    if len(active) and free.any():
        ends = np.where(near[0, active], -np.inf, 0.0), np.where(near[1, active], np.inf, 0.0)
        A = np.concatenate([J[active][:, free].T, np.diag(s[active])])
        y[active] = _signed_least_squares(A, np.concatenate([-g[free], np.zeros(len(active))]), ends)
    slackness = np.max(np.abs(y[active] * s[active]), initial=0.0)
    return Kkt(y, max(float(slackness), projected_norm(problem, x, g + y @ J)))


def _signed_least_squares(A: Array, b: Array, ends: tuple[Array, Array]) -> Array:
    """Return y (k,) that minimises |A y - b|, each entry between ends that are 0 or infinite."""
    from scipy.optimize import lsq_linear

    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    with np.errstate(invalid="ignore"):  # scipy multiplies infinite ends by 0 where A has fewer rows than columns
        return np.asarray(lsq_linear(A / size, b, bounds=ends).x) / size


def projected_norm(problem: Problem, x: Array, slope: Array) -> float:
    """Return the largest component of a gradient (n,), without those that an active bound cancels."""
    below, above = at_bounds(problem, x)
    slope = np.where(below, np.minimum(slope, 0.0), slope)
    slope = np.where(above, np.maximum(slope, 0.0), slope)
    return float(np.max(np.abs(slope), initial=0.0))


def at_bounds(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return which unknowns are at their lower bound and which at their upper (n,)."""
    return x <= problem.lower + AT_BOUND, x >= problem.upper - AT_BOUND


def columns_of(problem: ConstrainedProblem, c: Array, optimality: Kkt) -> dict[str, float]:
    """Return the values of the columns `report_names`, constraints and multipliers in their own units."""
    if not len(c):
        return {}
    values = {VIOLATION: most_violated(c, problem.c_low, problem.c_high), KKT: optimality.residual}
    each = zip(problem.constraint_names, problem.scales, c, optimality.multipliers, strict=True)
    for name, scale, value, y in each:
        values |= {CONSTRAINT + name: float(value * scale), MULTIPLIER + name: float(y / scale)}
    return values


def violations_in_row(problem: ConstrainedProblem, row: Mapping[str, float]) -> Array:
    """Return the violations (m,) from a row of the history."""
    c = np.array([row[CONSTRAINT + name] for name in problem.constraint_names]) / problem.scales
    return violation(c, problem.c_low, problem.c_high)


def verdict(problem: ConstrainedProblem, x: Array, c: Array, tolerance: float) -> str:
    """Describe the constraint with the largest violation, the other violated ones, and the active bounds."""
    excess = violation(c, problem.c_low, problem.c_high)
    k = int(np.argmax(excess))
    unit = float(problem.scales[k])
    low, high, value = (unit * float(v) for v in (problem.c_low[k], problem.c_high[k], c[k]))
    wanted = f"{low:g}" if low == high else f"at most {high:g}" if value > high else f"at least {low:g}"
    scaled = "" if unit == 1.0 else f" ({excess[k]:.3g} of its scale)"
    others = [name for i, name in enumerate(problem.constraint_names) if i != k and excess[i] > tolerance]
    less = f"; {listed(others)} {'is' if len(others) == 1 else 'are'} violated less" if others else ""
    J = problem.gradients_and_constraints(x)[3]
    constant = [name for i, name in enumerate(problem.constraint_names) if excess[i] > tolerance and not np.any(J[i])]
    stuck = f"; no unknown has an effect on {listed(constant)}" if constant else ""
    return (
        f"constraint '{problem.constraint_names[k]}' is {value:.6g}, wanted {wanted}: violated by "
        f"{unit * excess[k]:.3g}{scaled}, the least that was found{less}{stuck}; "
        f"{problem.bounds_in_words(*at_bounds(problem, x))}"
    )


def require_constraints(problem: Any, name: str) -> None:
    """Raise UsageError for a problem that cannot have constraints."""
    if not hasattr(problem, "gradients_and_constraints"):
        raise UsageError(f"{name} minimises an objective under constraints; to fit data take least_squares")


class ConstrainedTrials(Trials):
    """The functions that a solver calls, logged and counted; the best point is the one with the smallest violation.

    Among points that meet all constraints, the one with the smallest f is the best.
    """

    problem: ConstrainedProblem

    def __init__(self, problem: Any, session: Session, max_iterations: int, tolerance: float) -> None:
        super().__init__(problem, session, max_iterations)
        self.tolerance = tolerance
        self.best_c = np.zeros(0)
        self._best_rank = (np.inf, np.inf, np.inf)
        self._values: dict[bytes, tuple[float, Array]] = {}
        self._gradients: dict[bytes, dict[str, Array]] = {}

    def values(self, x: Array) -> tuple[float, Array]:
        """Return f and c (m,) at x; forward rollouts give them if the gradients are not known."""
        key = x.tobytes()
        if key not in self._values:

            def compute() -> dict[str, Array]:
                f, c = self.problem.values_and_constraints(x)
                require_finite(x, loss=np.asarray(f), constraints=c)
                return {"f": np.array(f), "c": c}

            self._keep(x, self._request("values", x, compute))
        return self._values[key]

    def gradients(self, x: Array) -> dict[str, Array]:
        """Return f (), g (n,), c (m,), J (m, n) and the terms at x."""
        key = x.tobytes()
        if key not in self._gradients:

            def compute() -> dict[str, Array]:
                f, g, c, J = self.problem.gradients_and_constraints(x)
                require_finite(x, loss=np.asarray(f), gradient=g, constraints=c, Jacobian=J)
                return {"f": np.array(f), "g": g, "c": c, "J": J, "terms": np.array(self.problem.term_values(), float)}

            answer = self._request("gradients", x, compute)
            # the previous one is kept too: NLopt's SLSQP goes back to the previous point
            self._gradients = dict([*self._gradients.items()][-1:]) | {key: answer}
            self._keep(x, answer)
            if not self._started:
                self._started = True
                self._record(x, answer)
        return self._gradients[key]

    def violated(self, x: Array) -> float:
        """Return the largest violation at x."""
        return most_violated(self.values(x)[1], self.problem.c_low, self.problem.c_high)

    def accept(self, x: Array, optimality: Kkt | None = None) -> None:
        """Count an iteration that ended at x, with multipliers and residual of the solver if it has them."""
        answer = self.gradients(x.copy())
        self.iteration += 1
        self._record(x, answer, optimality)
        # from the answer: gradients are stored longer than values, and a solver may go back to an earlier point
        self._values = {x.tobytes(): (float(answer["f"]), answer["c"])}
        self._at_limit()

    def _keep(self, x: Array, answer: dict[str, Array]) -> None:
        loss, c = float(answer["f"]), answer["c"]
        self._values[x.tobytes()] = loss, c
        rank = ranked(violation(c, self.problem.c_low, self.problem.c_high), loss, self.tolerance)
        if rank < self._best_rank:
            self._best_rank, self.best_x, self.best_loss, self.best_c = rank, x.copy(), loss, c

    def _record(self, x: Array, answer: dict[str, Array], optimality: Kkt | None = None) -> None:
        optimality = optimality or kkt(self.problem, x, answer["g"], answer["c"], answer["J"], self.tolerance)
        terms = terms_of(self.problem, answer["terms"]) | columns_of(self.problem, answer["c"], optimality)
        slope = (
            answer["g"] + optimality.multipliers @ answer["J"]
        )  # the gradient of the Lagrangian, which vanishes at a minimum
        self.session.report(self.iteration, x.copy(), float(answer["f"]), slope, terms)

    @property
    def feasible(self) -> bool:
        """Whether the best point meets all constraints."""
        return self._best_rank[0] == 0.0


class ReplayedConstrained(ConstrainedOptimizer, Replayed):
    """Base of solvers that support constraints and whose evaluations are replayed."""

    def require(self, problem: Problem) -> None:
        """Raise UsageError for a fit to data, and for an objective that changes from iteration to iteration."""
        require_constraints(problem, self.name)
        super().require(problem)

    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise; the status is `infeasible`, with a verdict, if it ends before the constraints are met."""
        self.require(problem)
        trials = ConstrainedTrials(problem, session, self.max_iterations, self.constraint_tolerance)
        outcome = minimise_with_restarts(self.attempt, trials)
        if trials.feasible or outcome.status in ("failed", "stopped"):
            return outcome
        return infeasible(trials.problem, outcome, trials.best_c, trials.tolerance)


def infeasible(problem: ConstrainedProblem, outcome: Outcome, c: Array, tolerance: float) -> Outcome:
    """Return the outcome with status `infeasible` and the verdict, for c (m,) at its point.

    This does not prove that no feasible point exists: nonlinear constraints may have local minima of the violation.
    """
    hint = {
        "iteration_limit": "not met yet, more iterations may help: ",
        "stalled": "not met, and the search got stuck; another start or solver may help: ",
    }.get(outcome.status, "not met where the search converged; another start or solver may help: ")
    message = f"{hint}{verdict(problem, outcome.x, c, tolerance)} ({outcome.message})"
    return replace(outcome, status="infeasible", message=message)
