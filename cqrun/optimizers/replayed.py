"""What scipy's optimizers share: evaluations pass through the run's log, failed trials shrink the box.

scipy cannot save its state. So a resumed run starts it again from the beginning and answers its
evaluations from the log; as the optimizer is deterministic it comes to where it was, bit for bit; on
a machine that adds up in another order, but for round-off.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cqrun.optimizers.base import (
    Optimizer,
    Outcome,
    Problem,
    Session,
    Status,
    TrialFailed,
    checked_value_and_grad,
    one_blas_thread,
    refuse_stochastic,
    require_finite,
    terms_of,
)
from cqrun.plugin.contract import Array

RESTARTS = 3
"""How often a failed trial halves the box before the run fails."""

AT_BOUND = 1e-3
"""Distance from a bound, in widths of the box, at which a point counts as held by it."""


class Seen(NamedTuple):
    """A point whose loss and gradient are known."""

    loss: float
    grad: Array
    terms: Array


class Halt(Exception):
    """Leaves scipy from inside a callback or an evaluation."""

    def __init__(self, status: Status, message: str) -> None:
        self.status, self.message = status, message
        super().__init__(message)


class Trials:
    """The functions that scipy calls: logged, counted, and watched for the best point.

    Args:
        problem: what is minimised.
        session: the log, the history and the wish to stop.
        max_iterations: accepted steps over all restarts.

    Attributes:
        asked: evaluations that were asked for, computed or replayed.
    """

    def __init__(self, problem: Problem, session: Session, max_iterations: int) -> None:
        self.problem, self.session, self.max_iterations = problem, session, max_iterations
        self.iteration = self.asked = 0
        self.best_x: Array | None = None
        self.best_loss = np.inf
        self._seen: dict[bytes, Seen] = {}
        self._started = False
        self._last_x = problem.start

    def value_and_grad(self, x: Array) -> tuple[float, Array]:
        """Return f and its gradient (n,)."""
        answer = self._ask("value_and_grad", x, lambda: checked_value_and_grad(self.problem, x))
        loss = float(answer["f"])
        self._note_best(x, loss)
        self._note_seen(x, Seen(loss, answer["g"], answer["terms"]))
        return loss, answer["g"].copy()

    def residuals(self, x: Array) -> Array:
        """Return r (m,)."""

        def compute() -> dict[str, Array]:
            r = self.problem.residuals(x)
            require_finite(x, residuals=r)
            return {"r": r}

        r = self._ask("residuals", x, compute)["r"]
        self._note_best(x, 0.5 * float(r @ r))
        return r

    def jacobian(self, x: Array) -> Array:
        """Return J (m, n)."""

        def compute() -> dict[str, Array]:
            r, jacobian = self.problem.residuals_and_jacobian(x)
            require_finite(x, residuals=r, Jacobian=jacobian)
            return {"r": r, "J": jacobian, "terms": np.array(self.problem.term_values(), float)}

        answer = self._ask("jacobian", x, compute)
        r, jacobian = answer["r"], answer["J"]
        self._note_seen(x, Seen(0.5 * float(r @ r), jacobian.T @ r, answer["terms"]))
        return jacobian

    def accept(self, x: Array) -> None:
        """Count an iteration that ended at x; scipy's callback."""
        self.iteration += 1
        seen = self._seen[x.tobytes()]
        self._seen = {x.tobytes(): seen}
        self._report(x, seen)
        self._at_limit()

    def _at_limit(self) -> None:
        if self.iteration >= self.max_iterations:
            raise Halt("iteration_limit", f"{self.max_iterations} iterations, the limit")

    def loss_at(self, x: Array) -> float:
        """Return f at an accepted point."""
        return self._seen[x.tobytes()].loss

    def outcome(self, status: Status, message: str) -> Outcome:
        """Return an outcome at the best point so far."""
        x = self.problem.start if self.best_x is None else self.best_x
        return Outcome(x.copy(), self.best_loss, status, message, self.iteration)

    def distance_to_last(self) -> float:
        """Return how far the last trial was from the best point, in the largest coordinate.

        Where it was that very point (a Jacobian that failed), 1: scaled coordinates are of order one.
        """
        return 1.0 if self.best_x is None else float(np.max(np.abs(self._last_x - self.best_x))) or 1.0

    def _ask(self, kind: str, x: Array, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
        if self.session.should_stop():
            raise Halt("stopped", f"asked to stop in iteration {self.iteration + 1}")
        self._last_x = x.copy()
        self.asked += 1
        return self.session.evaluate(kind, x, compute)

    def _note_best(self, x: Array, loss: float) -> None:
        if loss < self.best_loss:
            self.best_x, self.best_loss = x.copy(), loss

    def _note_seen(self, x: Array, seen: Seen) -> None:
        self._seen[x.tobytes()] = seen
        if not self._started:
            self._started = True
            self._report(x, seen)

    def _report(self, x: Array, seen: Seen) -> None:
        terms = terms_of(self.problem, seen.terms)
        self.session.report(self.iteration, x.copy(), seen.loss, seen.grad, terms)


Attempt = Callable[[Any, Array, Array, Array], tuple[Status, str]]
"""One call of scipy: (trials, start, lower, upper) -> status, message."""


class Replayed(Optimizer):
    """Base of optimizers that cannot save their state, and whose evaluations are replayed instead."""

    max_iterations: int

    def require(self, problem: Problem) -> None:
        """Refuse an objective that is another one at every iteration."""
        refuse_stochastic(problem, self)

    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise with exact resume through the session's log; UsageError as `require`."""
        self.require(problem)
        return minimise_with_restarts(self.attempt, Trials(problem, session, self.max_iterations))

    @abstractmethod
    def attempt(self, trials: Any, x: Array, lower: Array, upper: Array) -> tuple[Status, str]:
        """Minimise once from x in a box (n,), by the functions of `trials`; return how it ended."""


def minimise_with_restarts(attempt: Attempt, trials: Trials) -> Outcome:
    """Run `attempt`; after a failed trial, again from the best point in a box of half the size.

    BLAS runs on one thread meanwhile: sums in another order would make the replay diverge.
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
            if restarts and _held_by_box(trials.best_x, lower, upper, problem):
                status, message = "stalled", f"{message}; held by the box that failed trials had shrunk"
            return trials.outcome(status, message)


def half_box(x: Array, lower: Array, upper: Array, reach: float) -> tuple[Array, Array]:
    """Return the box shrunk by half towards x; where it has no end, one half of `reach` away."""
    down = np.where(np.isfinite(lower), x - lower, reach)
    up = np.where(np.isfinite(upper), upper - x, reach)
    return x - 0.5 * down, x + 0.5 * up


def _held_by_box(x: Array | None, lower: Array, upper: Array, problem: Problem) -> bool:
    margin = AT_BOUND * (upper - lower)
    below = (x - lower <= margin) & (lower > problem.lower)
    above = (upper - x <= margin) & (upper < problem.upper)
    return bool(np.any(below | above))
