"""Minimising under constraints: what such a problem gives, how far they are violated, and how far x is from a minimum.

    minimise f(x)   over   lower <= x <= upper   where   c_low <= c(x) <= c_high

A constraint with equal ends is an equality. Its multiplier y is positive where c_high holds c back, negative where
c_low does, and nought where neither does. At a minimum the gradient of f + y.c vanishes but for what the box holds
(Karush, Kuhn and Tucker; J. Nocedal, S. Wright: Numerical optimization, 2006, section 12.3), and each y times the
distance s of its constraint from its end. The KKT residual is the largest component of both, with the multipliers that
make their Euclidean norm least, or with a solver's own. Only a constraint near an end has one: closer than the root of
the tolerance, which tells those that hold from others well before the end is reached (F. Facchinei, A. Fischer,
C. Kanzow: On the accurate identification of active constraints, SIAM J. Optim. 9, 1998).
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
"""Distance from an end of the box, in scaled coordinates, at which it holds x."""

CONSTRAINT, MULTIPLIER = "constraint:", "multiplier:"
"""Columns of the history, the last two with a constraint's name behind them."""


class ConstrainedProblem(Problem, Protocol):
    """A `Problem` with m constraints, each in the unit in which its violation is judged.

    Attributes:
        constraint_names: m names.
        c_low, c_high: (m,), may be infinite; equal for an equality.
        scales: (m,), what 1 of each is in its own unit.
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
        """Return f, c (m,) and the gradient (n,) of f + w.c, where w = weigh(c) counts as constant."""

    def bounds_in_words(self, below: Array, above: Array) -> str:
        """Return which unknowns are at a bound, given those at their lower and at their upper (n,), in words."""


class ConstrainedOptimizer(Optimizer):
    """Base of the optimizers that honour constraints; without any they minimise f."""

    constrained: ClassVar[bool] = True
    constraint_tolerance: float = Field(
        1e-6, gt=0, description="a constraint is met when it is violated by no more than this, in its scale"
    )


def report_names(problem: Any) -> list[str]:
    """Return the columns of the history that tell of constraints, none where there are none."""
    names = list(getattr(problem, "constraint_names", ()))
    own = [CONSTRAINT + name for name in names] + [MULTIPLIER + name for name in names]
    return [VIOLATION, KKT, *own] if names else []


def violation(c: Array, low: Array, high: Array) -> Array:
    """Return by how much each constraint is violated (m,)."""
    return np.maximum(0.0, np.maximum(low - c, c - high))


def most_violated(c: Array, low: Array, high: Array) -> float:
    """Return the largest violation, 0 without constraints."""
    return float(np.max(violation(c, low, high), initial=0.0))


def ranked(excess: Array, loss: float, tolerance: float) -> tuple[float, float, float]:
    """Return what orders points: the largest violation, then the sum of those above the tolerance, then the loss.

    Violations (m,) count in whole tolerances, so that one that nothing moves does not hide what becomes of the others.
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
    """Return the multipliers at x and how far it is from a minimum.

    Args:
        g, c, J: gradient (n,), constraints (m,) and their Jacobian (m, n) at x.
        tolerance: a constraint that is violated by no more is met.
    """
    inside = np.maximum(0.0, np.stack([c - problem.c_low, problem.c_high - c]))  # (2, m), from either end
    near = inside <= np.sqrt(tolerance)
    held = np.flatnonzero(near.any(axis=0))
    below, above = held_by_box(problem, x)
    free = ~below & ~above
    y, s = np.zeros(len(c)), inside.min(axis=0)
    if len(held) and free.any():
        ends = np.where(near[0, held], -np.inf, 0.0), np.where(near[1, held], np.inf, 0.0)
        A = np.concatenate([J[held][:, free].T, np.diag(s[held])])
        y[held] = _of_one_sign(A, np.concatenate([-g[free], np.zeros(len(held))]), ends)
    loose = np.max(np.abs(y[held] * s[held]), initial=0.0)
    return Kkt(y, max(float(loose), projected(problem, x, g + y @ J)))


def _of_one_sign(A: Array, b: Array, ends: tuple[Array, Array]) -> Array:
    """Return the y (k,) nearest to A y = b, each entry between ends that are 0 or infinite, whatever its unit."""
    from scipy.optimize import lsq_linear

    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    with np.errstate(invalid="ignore"):  # scipy multiplies infinite ends by 0 where A has fewer rows than columns
        return np.asarray(lsq_linear(A / size, b, bounds=ends).x) / size


def projected(problem: Problem, x: Array, slope: Array) -> float:
    """Return the largest component of a gradient (n,), without what leads out of a box that holds x."""
    below, above = held_by_box(problem, x)
    slope = np.where(below, np.minimum(slope, 0.0), slope)
    slope = np.where(above, np.maximum(slope, 0.0), slope)
    return float(np.max(np.abs(slope), initial=0.0))


def held_by_box(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Return which unknowns are at their lower bound and which at their upper (n,)."""
    return x <= problem.lower + AT_BOUND, x >= problem.upper - AT_BOUND


def columns_of(problem: ConstrainedProblem, c: Array, found: Kkt) -> dict[str, float]:
    """Return the columns of `report_names`; constraints and multipliers are for constraints in their own units."""
    if not len(c):
        return {}
    values = {VIOLATION: most_violated(c, problem.c_low, problem.c_high), KKT: found.residual}
    each = zip(problem.constraint_names, problem.scales, c, found.multipliers, strict=True)
    for name, scale, value, y in each:
        values |= {CONSTRAINT + name: float(value * scale), MULTIPLIER + name: float(y / scale)}
    return values


def excess_told(problem: ConstrainedProblem, row: Mapping[str, float]) -> Array:
    """Return the violations (m,) from the columns of `told`."""
    c = np.array([row[CONSTRAINT + name] for name in problem.constraint_names]) / problem.scales
    return violation(c, problem.c_low, problem.c_high)


def verdict(problem: ConstrainedProblem, x: Array, c: Array, tolerance: float) -> str:
    """Return in words which constraint is violated most, in its own unit, which others are, and what bounds hold x."""
    excess = violation(c, problem.c_low, problem.c_high)
    k = int(np.argmax(excess))
    unit = float(problem.scales[k])
    low, high, value = (unit * float(v) for v in (problem.c_low[k], problem.c_high[k], c[k]))
    wanted = f"{low:g}" if low == high else f"at most {high:g}" if value > high else f"at least {low:g}"
    scaled = "" if unit == 1.0 else f" ({excess[k]:.3g} of its scale)"
    others = [name for i, name in enumerate(problem.constraint_names) if i != k and excess[i] > tolerance]
    too = f"; {listed(others)} {'is' if len(others) == 1 else 'are'} violated less" if others else ""
    J = problem.gradients_and_constraints(x)[3]
    still = [name for i, name in enumerate(problem.constraint_names) if excess[i] > tolerance and not np.any(J[i])]
    stuck = f"; no unknown has a bearing on {listed(still)}" if still else ""
    return (
        f"constraint '{problem.constraint_names[k]}' is {value:.6g}, wanted {wanted}: violated by "
        f"{unit * excess[k]:.3g}{scaled}, the least that was found{too}{stuck}; "
        f"{problem.bounds_in_words(*held_by_box(problem, x))}"
    )


def require_constraints(problem: Any, name: str) -> None:
    """Refuse, with a UsageError, a problem that cannot say what its constraints are."""
    if not hasattr(problem, "gradients_and_constraints"):
        raise UsageError(f"{name} minimises an objective under constraints; to fit data take least_squares")


class ConstrainedTrials(Trials):
    """The functions that a solver calls, logged and counted; the best point is the one that violates least.

    Of points that violate nothing, the one of least f is best.
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
        """Return f and c (m,), by rollouts forward where the gradients are not known."""
        key = x.tobytes()
        if key not in self._values:

            def compute() -> dict[str, Array]:
                f, c = self.problem.values_and_constraints(x)
                require_finite(x, loss=np.asarray(f), constraints=c)
                return {"f": np.array(f), "c": c}

            self._keep(x, self._ask("values", x, compute))
        return self._values[key]

    def gradients(self, x: Array) -> dict[str, Array]:
        """Return f (), g (n,), c (m,), J (m, n) and the terms at x."""
        key = x.tobytes()
        if key not in self._gradients:

            def compute() -> dict[str, Array]:
                f, g, c, J = self.problem.gradients_and_constraints(x)
                require_finite(x, loss=np.asarray(f), gradient=g, constraints=c, Jacobian=J)
                return {"f": np.array(f), "g": g, "c": c, "J": J, "terms": np.array(self.problem.term_values(), float)}

            answer = self._ask("gradients", x, compute)
            # with the last one: NLopt's SLSQP comes back to the point before
            self._gradients = dict([*self._gradients.items()][-1:]) | {key: answer}
            self._keep(x, answer)
            if not self._started:
                self._started = True
                self._tell(x, answer)
        return self._gradients[key]

    def violated(self, x: Array) -> float:
        """Return the largest violation at x."""
        return most_violated(self.values(x)[1], self.problem.c_low, self.problem.c_high)

    def accept(self, x: Array, found: Kkt | None = None) -> None:
        """Count an iteration that ended at x, with the solver's own multipliers and residual if it has any."""
        answer = self.gradients(x.copy())
        self.iteration += 1
        self._tell(x, answer, found)
        # of the answer: gradients are kept longer than values, and a solver may come back to the point before last
        self._values = {x.tobytes(): (float(answer["f"]), answer["c"])}
        self._at_limit()

    def _keep(self, x: Array, answer: dict[str, Array]) -> None:
        loss, c = float(answer["f"]), answer["c"]
        self._values[x.tobytes()] = loss, c
        rank = ranked(violation(c, self.problem.c_low, self.problem.c_high), loss, self.tolerance)
        if rank < self._best_rank:
            self._best_rank, self.best_x, self.best_loss, self.best_c = rank, x.copy(), loss, c

    def _tell(self, x: Array, answer: dict[str, Array], found: Kkt | None = None) -> None:
        found = found or kkt(self.problem, x, answer["g"], answer["c"], answer["J"], self.tolerance)
        terms = terms_of(self.problem, answer["terms"]) | columns_of(self.problem, answer["c"], found)
        slope = answer["g"] + found.multipliers @ answer["J"]  # the Lagrangian's gradient: what has yet to vanish
        self.session.report(self.iteration, x.copy(), float(answer["f"]), slope, terms)

    @property
    def feasible(self) -> bool:
        """Whether the best point violates nothing."""
        return self._best_rank[0] == 0.0


class ReplayedConstrained(ConstrainedOptimizer, Replayed):
    """Base of solvers that honour constraints, and whose evaluations are replayed."""

    def require(self, problem: Problem) -> None:
        """Refuse what has no constraints to ask for, and what changes from iteration to iteration."""
        require_constraints(problem, self.name)
        super().require(problem)

    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise; status `infeasible` with a verdict where it ends before the constraints are met."""
        self.require(problem)
        trials = ConstrainedTrials(problem, session, self.max_iterations, self.constraint_tolerance)
        outcome = minimise_with_restarts(self.attempt, trials)
        if trials.feasible or outcome.status in ("failed", "stopped"):
            return outcome
        return infeasible(trials.problem, outcome, trials.best_c, trials.tolerance)


def infeasible(problem: ConstrainedProblem, outcome: Outcome, c: Array, tolerance: float) -> Outcome:
    """Return an outcome whose c (m,) violate constraints, with the verdict.

    None is a last word: where constraints are curved, a point that violates them less may be beyond a ridge.
    """
    hint = {
        "iteration_limit": "not met yet, more iterations may do: ",
        "stalled": "not met, and the search got stuck; another start or solver may do: ",
    }.get(outcome.status, "not met where the search converged; another start or solver may do: ")
    message = f"{hint}{verdict(problem, outcome.x, c, tolerance)} ({outcome.message})"
    return replace(outcome, status="infeasible", message=message)
