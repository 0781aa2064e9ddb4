"""What an optimizer is given and what it gives back.

Optimizers see scaled coordinates: one flat vector x (n,) of order one, between bounds. The problem knows
what x means; the session keeps what a later `cqrun resume` needs. Neither knows the optimizer.
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


class TrialFailed(Exception):
    """A trial whose rollout blew up: not an error of the run, but a point to stay away from.

    Args:
        reason: what happened, in words.
        body: name of the body, "" where none is to blame.
        particle: its particle, or -1.
        time: when [s].
        values: the trial values as text, such as `youngs_modulus = 2.1e5 Pa`.
    """

    def __init__(self, reason: str, *, body: str = "", particle: int = -1, time: float = 0.0, values: str = "") -> None:
        self.reason, self.body, self.particle = reason, body, int(particle)
        self.time, self.values = float(time), values
        where = f"body '{body}', particle {particle}, t = {time:.6g} s: " if body else ""
        super().__init__(f"{where}{reason}; trial values: {values}")


class Problem(Protocol):
    """A function to minimise over a box.

    The loss f is a float; where there are residuals r (m,), f = r.r / 2 over all parts.
    Every evaluation gives the same bits for the same x and batch, and raises TrialFailed where the rollout blows up.
    One with many rollouts to give may also have `values_at`; see `values_at` below.

    Attributes:
        start: initial x (n,).
        lower: least x (n,), may be -inf.
        upper: greatest x (n,), may be inf; above `lower` everywhere.
        n_batches: parts the data falls into (recordings, sequences); a mini-batch names some of them.
        term_names: names of the terms of the loss, () where it has but one.
        stochastic: whether every iteration draws its data anew (fresh goals). Then `batch` is (k,) in iteration k, and
            f of another batch is another function.
    """

    start: Array
    lower: Array
    upper: Array
    n_batches: int
    term_names: Sequence[str]
    stochastic: bool

    def value(self, x: Array, batch: tuple[int, ...] | None = None) -> float:
        """Return f, as `value_and_grad` does; nothing is prepared for a gradient."""

    def value_and_grad(self, x: Array, batch: tuple[int, ...] | None = None) -> tuple[float, Array]:
        """Return f and its gradient (n,), over all parts or scaled up from those in `batch`."""

    def residuals(self, x: Array) -> Array:
        """Return r (m,)."""

    def residuals_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Return r (m,) and J (m, n)."""

    def term_values(self) -> Array:
        """Return the terms of the loss at the last evaluation, in the order of `term_names`."""


class Session(Protocol):
    """What outlives the process: a replay log for scipy's optimizers, a state file for cqrun's own.

    Attributes:
        seed: of the run; an optimizer draws from nothing else.
    """

    seed: int

    def evaluate(self, kind: str, x: Array, compute: Callable[[], dict[str, Array]]) -> dict[str, Array]:
        """Return `compute()`, or what it returned (or how it failed) when this run was here before.

        Raises:
            TrialFailed: the trial blows up, now or then.
        """

    def restore(self) -> dict[str, Array] | None:
        """Return the last saved state, or None in a new run."""

    def save(self, state: dict[str, Array]) -> None:
        """Keep `state`, which holds at least `iteration` ()."""

    def report(self, iteration: int, x: Array, loss: float, grad: Array, terms: Mapping[str, float]) -> None:
        """Record the accepted point of an iteration; 0 is the start. Repeating a row changes nothing."""

    def note(self, text: str) -> None:
        """Write a line into the run's log."""

    def should_stop(self) -> bool:
        """Say whether the run was asked to stop."""


@dataclass(frozen=True)
class Outcome:
    """Where an optimizer ended.

    Args:
        x: the best point (n,); with mini-batches the last one.
        loss: f there (of the last mini-batch).
        status: why it ended.
        message: the same in words.
        iterations: how many it took.
    """

    x: Array
    loss: float
    status: Status
    message: str
    iterations: int


class Optimizer(Plugin):
    """Base of the plug-ins of kind `optimizer`.

    `gradients` says whether the method asks for `value_and_grad`: without, no adjoint need be compiled or planned.
    `squares` says that it asks for residuals, which only a fit to data has.
    """

    gradients: ClassVar[bool] = True
    squares: ClassVar[bool] = False
    max_iterations: int

    @property
    def draws(self) -> bool:
        """Whether it draws anything from the run's seed."""
        return False

    def require(self, problem: Problem) -> None:
        """Refuse, with a UsageError, a problem that the method cannot minimise; `minimise` begins with it."""

    @abstractmethod
    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise; what can go wrong with a trial ends in the outcome's status."""


class _OneBlasThread:
    """One context for all who want it: limits are the process's, and the last one to leave takes them off."""

    def __init__(self) -> None:
        self._lock, self._users = Lock(), 0
        self._limits: Any = None

    def __enter__(self) -> None:
        import scipy.optimize  # noqa: F401  its BLAS must be loaded before its threads are pinned
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


_ONE = _OneBlasThread()


def one_blas_thread() -> AbstractContextManager[Any]:
    """Return a context in which BLAS runs on one thread.

    Its sums then have one order, so that a replay meets the same bits; and its threads do not spin on cores that
    rollouts need: two runs side by side took 3.3 times as long.
    """
    return _ONE


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
    """Return f at every point, or how the trial failed.

    In one call where the problem has `values_at(points, batch)`, which returns the same: it may run them side by side.
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
    """Raise UsageError where an objective changes from iteration to iteration and the method cannot have that."""
    if problem.stochastic:
        constrained = len(getattr(problem, "constraint_names", ())) > 0
        others = "" if constrained else "use adam or sgd, or "  # these honour no constraints
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
