"""Base of scipy's optimizers: evaluations pass through the run's log, and failed trials shrink the box.

scipy cannot save its state. So a resumed run starts the optimizer again from the beginning and answers its evaluations
from the log. The optimizer is deterministic, so it reaches the same point bit-for-bit; on a machine that adds in
another order, up to rounding errors.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cqrun.errors import StopAsked
from cqrun.optimizers.base import (
    NOT_STARTED,
    Optimizer,
    Outcome,
    Problem,
    Session,
    Status,
    TrialFailed,
    asked_to_stop,
    checked_value_and_grad,
    one_blas_thread,
    refuse_stochastic,
    require_finite,
    terms_of,
)
from cqrun.plugin.contract import Array

RESTARTS = 3
"""How many times a failed trial halves the box before the run fails."""

AT_BOUND = 1e-3
"""Distance from a bound, in widths of the box, at which a point counts as at the bound."""


class Evaluation(NamedTuple):
    """Loss, gradient and terms at a point."""

    loss: float
    grad: Array
    terms: Array


class Halt(Exception):
    """Ends scipy's method from inside a callback or an evaluation."""

    def __init__(self, status: Status, message: str) -> None:
        self.status, self.message = status, message
        super().__init__(message)


class Trials:
    """The functions that scipy calls: they log and count evaluations, and keep the best point.

    Args:
        problem: problem to minimise.
        session: log, history and requests to stop.
        max_iterations: maximum number of accepted steps over all restarts.

    Attributes:
        requests: number of requested evaluations, computed or replayed.
    """

    def __init__(self, problem: Problem, session: Session, max_iterations: int) -> None:
        self.problem, self.session, self.max_iterations = problem, session, max_iterations
        self.iteration = self.requests = 0
        self.best_x: Array | None = None
        self.best_loss = np.inf
        self._evaluations: dict[bytes, Evaluation] = {}
        self._started = False
        self._last_x = problem.start

    def value_and_grad(self, x: Array) -> tuple[float, Array]:
        """Return f and its gradient (n,)."""
        answer = self._request("value_and_grad", x, lambda: checked_value_and_grad(self.problem, x))
        loss = float(answer["f"])
        self._note_best(x, loss)
        self._store(x, Evaluation(loss, answer["g"], answer["terms"]))
        return loss, answer["g"].copy()

    def residuals(self, x: Array) -> Array:
        """Return r (m,)."""

        def compute() -> dict[str, Array]:
            r = self.problem.residuals(x)
            require_finite(x, residuals=r)
            return {"r": r}

        r = self._request("residuals", x, compute)["r"]
        self._note_best(x, 0.5 * float(r @ r))
        return r

    def jacobian(self, x: Array) -> Array:
        """Return J (m, n)."""

        def compute() -> dict[str, Array]:
            r, jacobian = self.problem.residuals_and_jacobian(x)
            require_finite(x, residuals=r, Jacobian=jacobian)
            return {"r": r, "J": jacobian, "terms": np.array(self.problem.term_values(), float)}

        answer = self._request("jacobian", x, compute)
        r, jacobian = answer["r"], answer["J"]
        self._store(x, Evaluation(0.5 * float(r @ r), jacobian.T @ r, answer["terms"]))
        return jacobian

    def accept(self, x: Array) -> None:
        """Count an iteration that ended at x (scipy's callback)."""
        self.iteration += 1
        evaluation = self._evaluations[x.tobytes()]
        self._evaluations = {x.tobytes(): evaluation}
        self._report(x, evaluation)
        self._at_limit()

    def _at_limit(self) -> None:
        if self.iteration >= self.max_iterations:
            raise Halt("iteration_limit", f"{self.max_iterations} iterations, the limit")

    def loss_at(self, x: Array) -> float:
        """Return f at an accepted point."""
        return self._evaluations[x.tobytes()].loss

    def outcome(self, status: Status, message: str) -> Outcome:
        """Return an outcome at the best point so far."""
        x = self.problem.start if self.best_x is None else self.best_x
        return Outcome(x.copy(), self.best_loss, status, message, self.iteration)

    def distance_to_last(self) -> float:
        """Return the largest coordinate of the difference between the last trial and the best point.

        If both are the same point (a Jacobian failed), it is 1, because scaled coordinates are of order 1.
        """
        return 1.0 if self.best_x is None else float(np.max(np.abs(self._last_x - self.best_x))) or 1.0

    def _request(self, kind: str, x: Array, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
        if self.session.should_stop():
            raise self._stopped()
        self._last_x = x.copy()
        self.requests += 1
        try:
            return self.session.evaluate(kind, x, compute)
        except StopAsked:
            raise self._stopped() from None

    def _stopped(self) -> Halt:
        return Halt("stopped", asked_to_stop(self.iteration if self._started else NOT_STARTED))

    def _note_best(self, x: Array, loss: float) -> None:
        if loss < self.best_loss:
            self.best_x, self.best_loss = x.copy(), loss

    def _store(self, x: Array, evaluation: Evaluation) -> None:
        self._evaluations[x.tobytes()] = evaluation
        if not self._started:
            self._started = True
            self._report(x, evaluation)

    def _report(self, x: Array, evaluation: Evaluation) -> None:
        terms = terms_of(self.problem, evaluation.terms)
        self.session.report(self.iteration, x.copy(), evaluation.loss, evaluation.grad, terms)


Attempt = Callable[[Any, Array, Array, Array], tuple[Status, str]]
"""One call of scipy: (trials, start, lower, upper) -> status, message."""


class Replayed(Optimizer):
    """Base of optimizers that cannot save their state; their evaluations are replayed instead."""

    max_iterations: int

    def require(self, problem: Problem) -> None:
        """Raise UsageError for an objective that changes from iteration to iteration."""
        refuse_stochastic(problem, self)

    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise with exact resume through the session's log; UsageError as `require`."""
        self.require(problem)
        return minimise_with_restarts(self.attempt, Trials(problem, session, self.max_iterations))

    @abstractmethod
    def attempt(self, trials: Any, x: Array, lower: Array, upper: Array) -> tuple[Status, str]:
        """Minimise once from x (n,) in a box with the functions of `trials`; return status and message."""


def minimise_with_restarts(attempt: Attempt, trials: Trials) -> Outcome:
    """Run `attempt`; after a failed trial, run it again from the best point in a box of half the size.

    Meanwhile BLAS runs on one thread: sums in another order would make a replay diverge.
    """
    problem, session = trials.problem, trials.session
    lower, upper = problem.lower, problem.upper
    x = np.clip(problem.start, lower, upper)
    restarts = 0
    with one_blas_thread():
        while True:
            try:
                status, message = attempt(trials, x, lower, upper)
            except Halt as halt:
                return trials.outcome(halt.status, halt.message)
            except TrialFailed as failure:
                if trials.best_x is None:
                    return trials.outcome("failed", f"the start itself fails: {failure}")
                if restarts == RESTARTS:
                    return trials.outcome("failed", f"{failure} (after {RESTARTS} restarts in a smaller box)")
                restarts += 1
                x = trials.best_x
                lower, upper = half_box(x, lower, upper, trials.distance_to_last())
                session.note(f"restart {restarts} of {RESTARTS} from the best point, in half the box")
                continue
            if restarts and _at_shrunken_box(trials.best_x, lower, upper, problem):
                status, message = "stalled", f"{message}; at a bound of the box that failed trials have shrunk"
            return trials.outcome(status, message)


def half_box(x: Array, lower: Array, upper: Array, reach: float) -> tuple[Array, Array]:
    """Return the box, shrunk by half towards x; infinite bounds become half of `reach` away from x."""
    down = np.where(np.isfinite(lower), x - lower, reach)
    up = np.where(np.isfinite(upper), upper - x, reach)
    return x - 0.5 * down, x + 0.5 * up


def _at_shrunken_box(x: Array | None, lower: Array, upper: Array, problem: Problem) -> bool:
    margin = AT_BOUND * (upper - lower)
    below = (x - lower <= margin) & (lower > problem.lower)
    above = (upper - x <= margin) & (upper < problem.upper)
    return bool(np.any(below | above))
