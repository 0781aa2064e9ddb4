"""Interfaces of an optimizer: the problem, the session and the outcome.

Optimizers see scaled coordinates: one flat vector x (n,) of order 1, between bounds. The problem knows what x means;
the session stores what a later `cqrun resume` needs. Neither of them knows the optimizer.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from threading import Lock
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from cqrun.errors import UsageError
from cqrun.plugin.contract import Array, Plugin

Status = Literal["converged", "iteration_limit", "stalled", "infeasible", "failed", "stopped"]


NOT_STARTED = -1
"""Number of the last iteration before the start is evaluated, which is iteration 0."""


def asked_to_stop(iteration: int) -> str:
    """Return the message of a search that was asked to stop, given its last finished iteration."""
    return "asked to stop " + ("before the first iteration" if iteration < 0 else f"after iteration {iteration}")


class TrialFailed(Exception):
    """A trial whose rollout blew up. This is not an error of the run, but a point to avoid.

    Args:
        reason: what happened, in words.
        body: name of the body where it happened, or "".
        particle: number of the particle, or -1.
        time: simulated time [s].
        values: the trial values as text, such as `youngs_modulus = 2.1e5 Pa`.
    """

    def __init__(self, reason: str, *, body: str = "", particle: int = -1, time: float = 0.0, values: str = "") -> None:
        self.reason, self.body, self.particle = reason, body, int(particle)
        self.time, self.values = float(time), values
        where = f"body '{body}', particle {particle}, t = {time:.6g} s: " if body else ""
        super().__init__(f"{where}{reason}; trial values: {values}")


class Problem(Protocol):
    """A function to minimise over a box.

    The loss f is a float. If there are residuals r (m,), f = r.r / 2 over all parts. Every evaluation is bit-for-bit
    reproducible for the same x and batch, and raises TrialFailed if the rollout blows up. A problem that can run
    several rollouts side by side also has a method `values_at`; see the function `values_at` below.

    Attributes:
        start: initial x (n,).
        lower: lower bounds of x (n,), may be -inf.
        upper: upper bounds of x (n,), may be inf; above `lower` everywhere.
        n_batches: number of parts of the data (recordings, sequences); a mini-batch consists of some of them.
        term_names: names of the terms of the loss; () if there is only one.
        stochastic: whether every iteration draws new data (fresh goals). Then `batch` is (k,) in iteration k, and f is
            a different function for each batch.
    """

    start: Array
    lower: Array
    upper: Array
    n_batches: int
    term_names: Sequence[str]
    stochastic: bool

    def value(self, x: Array, batch: tuple[int, ...] | None = None) -> float:
        """Return f, as `value_and_grad` does, without computing a gradient."""

    def value_and_grad(self, x: Array, batch: tuple[int, ...] | None = None) -> tuple[float, Array]:
        """Return f and its gradient (n,), over all parts, or scaled up from those in `batch`."""

    def residuals(self, x: Array) -> Array:
        """Return r (m,)."""

    def residuals_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Return r (m,) and J (m, n)."""

    def term_values(self) -> Array:
        """Return the terms of the loss at the last evaluation, in the order of `term_names`."""


class Session(Protocol):
    """Storage that outlives the process: a replay log for scipy's optimizers, a state file for those of cqrun.

    Attributes:
        seed: seed of the run, the only source of an optimizer's random numbers.
    """

    seed: int

    def evaluate(self, kind: str, x: Array, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
        """Return `compute()`, or its logged result if this run has evaluated it before.

        Raises:
            TrialFailed: the trial blows up, or did so when it was logged.
        """

    def restore(self) -> dict[str, Array] | None:
        """Return the last saved state, or None in a new run."""

    def save(self, state: dict[str, Array]) -> None:
        """Store `state`, which contains at least `iteration` ()."""

    def report(self, iteration: int, x: Array, loss: float, grad: Array, terms: Mapping[str, float]) -> None:
        """Record the accepted point of an iteration, 0 for the start. Recording a row again changes nothing."""

    def note(self, text: str) -> None:
        """Write a line into the run's log."""

    def should_stop(self) -> bool:
        """Return whether the run was asked to stop."""


@dataclass(frozen=True)
class Outcome:
    """The result of an optimizer.

    Args:
        x: the best point (n,); with mini-batches, the last one.
        loss: f there (with mini-batches, of the last one).
        status: why it ended.
        message: the same in words.
        iterations: number of iterations.
    """

    x: Array
    loss: float
    status: Status
    message: str
    iterations: int


class Optimizer(Plugin):
    """Base of the plug-ins of kind `optimizer`.

    `gradients`: the method needs `value_and_grad`; if not, no adjoint is compiled or planned. `squares`: it needs
    residuals, which only a fit to data has.
    """

    gradients: ClassVar[bool] = True
    squares: ClassVar[bool] = False
    max_iterations: int

    @property
    def draws(self) -> bool:
        """Whether it uses random numbers from the run's seed."""
        return False

    def require(self, problem: Problem) -> None:
        """Raise UsageError for a problem that the method cannot minimise; `minimise` calls this first."""

    @abstractmethod
    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise; failed trials end in the outcome's status."""


class _OneBlasThread:
    """One shared context, because the limit applies to the process: the last user to leave removes it."""

    def __init__(self) -> None:
        self._lock, self._users = Lock(), 0
        self._limits: Any = None

    def __enter__(self) -> None:
        import scipy.optimize  # noqa: F401  its BLAS must be loaded before its threads are limited
        from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

        with self._lock:
            if self._users == 0:
                self._limits = threadpool_limits(1, user_api="blas")
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._limits.restore_original_limits()


_SHARED = _OneBlasThread()


def one_blas_thread() -> AbstractContextManager[Any]:
    """Return a context in which BLAS runs on one thread.

    The order of its sums is then fixed, so a replay is bit-for-bit identical. And its threads do not spin on cores that
    rollouts need: without this, two runs side by side took 3.3 times as long.
    """
    return _SHARED


def terms_of(problem: Problem, values: Array) -> dict[str, float]:
    """Return the terms of the loss by name."""
    return {name: float(value) for name, value in zip(problem.term_names, values, strict=True)}


def checked_value_and_grad(problem: Problem, x: Array, batch: tuple[int, ...] | None = None) -> dict[str, Array]:
    """Return f (), g (n,) and terms (k,) at x.

    Raises:
        TrialFailed: the trial blew up, or f or g is not finite.
    """
    f, g = problem.value_and_grad(x, batch)
    require_finite(x, loss=np.asarray(f), gradient=g)
    return {"f": np.array(f, float), "g": np.array(g, float), "terms": np.array(problem.term_values(), float)}


def values_at(
    problem: Problem, points: Sequence[Array], batch: tuple[int, ...] | None = None
) -> list[float | TrialFailed]:
    """Return f at every point, or the failure of the trial.

    If the problem has a method `values_at(points, batch)`, which returns the same, it is called once for all points,
    and may run them side by side.
    """
    together = getattr(problem, "values_at", None)
    if together is not None:
        return list(together(points, batch))

    def attempt(x: Array) -> float | TrialFailed:
        try:
            return problem.value(x, batch)
        except TrialFailed as failure:
            return failure

    return [attempt(x) for x in points]


def refuse_stochastic(problem: Problem, optimizer: Optimizer) -> None:
    """Raise UsageError if the objective changes from iteration to iteration; for methods that cannot minimise that."""
    if problem.stochastic:
        constrained = len(getattr(problem, "constraint_names", ())) > 0
        others = "" if constrained else "use adam or sgd, or "  # these do not support constraints
        raise UsageError(
            f"the objective draws fresh goals at every iteration, and optimizer {optimizer.name} needs the same loss "
            f"twice at the same point: {others}fix the set of goals (`episodes.fresh: false`)"
        )


def require_finite(x: Array, **arrays: Array) -> None:
    """Raise TrialFailed if any of `arrays`, named for the message, is not finite."""
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            values = np.array2string(x, threshold=12, separator=", ")
            raise TrialFailed(f"the {name.replace('_', ' ')} is not finite", values=f"x = {values}")
