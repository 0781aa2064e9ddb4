"""CMA-ES: a gradient-free baseline, which uses values only."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from cqrun.errors import MissingExtra, StopAsked
from cqrun.optimizers.base import (
    NOT_STARTED,
    Optimizer,
    Outcome,
    Problem,
    Session,
    Status,
    TrialFailed,
    asked_to_stop,
    one_blas_thread,
    require_finite,
    values_at,
)
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugin

HALVINGS = 5
"""How many times in a row a generation without a good trial halves sigma before the run fails."""

CONVERGED = {"tolx", "tolfun", "tolfunhist"}
"""Termination reasons of the library that mean a minimum; others mean that it cannot continue."""


@plugin("optimizer", "cma_es")
class CmaEs(Optimizer):
    """CMA-ES: draw x ~ m + sigma N(0, C), rank by f, move m, sigma and C towards the better half.

    It uses values only: as a baseline for methods with gradients, and for losses without a gradient. An iteration is a
    generation. Its row in the history is its best trial, with nan for gradient and terms. Failed trials rank last.
    N. Hansen: The CMA evolution strategy: a tutorial, arXiv 1604.00772 (2016); the library `cma` (extra `evo`).
    """

    gradients: ClassVar[bool] = False
    max_iterations: int = Field(100, ge=1, description="maximum number of generations")
    population: int | None = Field(
        None, ge=4, le=10_000, description="number of trials in a generation; 4 + 3 ln n if absent"
    )
    sigma: float = Field(0.3, gt=0, description="standard deviation of the first generation, in scaled coordinates")
    function_tolerance: float = Field(
        1e-11, ge=0, description="converged when the losses of recent generations differ by less"
    )
    step_tolerance: float = Field(
        1e-11, ge=0, description="converged when the standard deviation is less in every coordinate"
    )

    @property
    def draws(self) -> bool:
        """Always: its trials are random."""
        return True

    def require(self, problem: Problem) -> None:
        """Check that the library is installed, then as in the base class.

        Raises:
            MissingExtra: `cma` is not installed. UsageError: as in the base class.
        """
        library()
        super().require(problem)

    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise with exact resume through the session's log.

        Meanwhile BLAS runs on one thread: sums in another order would make a replay diverge.

        Raises:
            MissingExtra: the library `cma` is not installed.
        """
        cma = library()
        start = np.clip(np.asarray(problem.start, float), problem.lower, problem.upper)
        with one_blas_thread():
            strategy = cma.CMAEvolutionStrategy(start, self.sigma, self._options(problem, session.seed))
            return _Search(self, problem, session, strategy, start).run()

    def _options(self, problem: Problem, seed: int) -> dict[str, Any]:
        rng = np.random.default_rng(seed)
        population = {} if self.population is None else {"popsize": self.population}
        return population | {
            "bounds": [list(problem.lower), list(problem.upper)],
            "randn": lambda *shape: rng.standard_normal(shape),  # its default would seed NumPy's global generator
            "seed": np.nan,
            "tolfun": self.function_tolerance,
            "tolfunhist": 0.1 * self.function_tolerance,
            "tolx": self.step_tolerance,
            "maxiter": np.inf,
            "verbose": -9,
            "verb_disp": 0,
            "verb_log": 0,
            "signals_filename": "",
        }


class _Search:
    """One run of CMA-ES: its generations, best point and failures."""

    def __init__(self, method: CmaEs, problem: Problem, session: Session, strategy: Any, start: Array) -> None:
        self.method, self.problem, self.session, self.strategy = method, problem, session, strategy
        self.generation = self.failures = 0
        self.best_x, self.best_loss = start, np.inf
        self.started = False

    def run(self) -> Outcome:
        """Evaluate the start, then generation after generation."""
        try:
            return self._search()
        except StopAsked:
            return self._outcome("stopped", asked_to_stop(self.generation if self.started else NOT_STARTED))

    def _search(self) -> Outcome:
        self._check()
        try:
            answer = self.session.evaluate("value", self.best_x, self._at_start)
        except TrialFailed as failure:
            return self._outcome("failed", f"the start itself fails: {failure}")
        self._record(self.best_x, float(answer["f"]))
        self.started = True
        while True:
            if reasons := self.strategy.stop():
                status: Status = "converged" if set(reasons) <= CONVERGED else "stalled"
                return self._outcome(status, f"CMA-ES: {_listed(reasons.items())}")
            if self.generation >= self.method.max_iterations:
                return self._outcome("iteration_limit", f"{self.generation} generations, the limit")
            self._check()
            points = np.array(self.strategy.ask())
            losses = self.session.evaluate("values", points, partial(self._at, points))["f"]
            if np.isfinite(losses).any():
                self._advance(points, losses)
            elif self.failures == HALVINGS:
                message = f"every trial of generation {self.generation + 1} failed (after {HALVINGS} halvings of sigma)"
                return self._outcome("failed", f"{message}; log.txt has the reasons")
            else:
                self.failures += 1
                self.strategy.sigma *= 0.5
                self.session.note(f"every trial of generation {self.generation + 1} failed: sigma halved")

    def _check(self) -> None:
        if self.session.should_stop():
            raise StopAsked

    def _advance(self, points: Array, losses: Array) -> None:
        """Give a generation (population, n) and its losses (population,), inf for failed trials, to the strategy."""
        worst = float(np.max(losses[np.isfinite(losses)]))
        ranked = np.where(np.isfinite(losses), losses, worst + abs(worst) + 1.0)  # inf - inf is nan
        self.strategy.tell(list(points), list(ranked))
        self.generation, self.failures = self.generation + 1, 0
        best = int(np.argmin(losses))
        self._record(points[best], float(losses[best]))

    def _at_start(self) -> dict[str, Array]:
        f = self.problem.value(self.best_x, self._batch(0))
        require_finite(self.best_x, loss=np.asarray(f))
        return {"f": np.array(f, float)}

    def _at(self, points: Array) -> dict[str, Array]:
        answers = values_at(self.problem, list(points), self._batch(self.generation + 1))
        failed = [answer for answer in answers if isinstance(answer, TrialFailed)]
        if failed:
            self.session.note(
                f"generation {self.generation + 1}: {len(failed)} of {len(answers)} trials failed, such as: {failed[0]}"
            )
        losses = np.array([np.inf if isinstance(answer, TrialFailed) else answer for answer in answers], float)
        return {"f": np.where(np.isfinite(losses), losses, np.inf)}

    def _batch(self, generation: int) -> tuple[int, ...] | None:
        return (generation,) if self.problem.stochastic else None

    def _record(self, x: Array, loss: float) -> None:
        """Record the best trial of a generation, and keep it if it is the best so far."""
        if self.problem.stochastic or loss < self.best_loss:  # losses with other goals cannot be compared
            self.best_x, self.best_loss = x.copy(), loss
        unknown = dict.fromkeys(self.problem.term_names, np.nan)
        self.session.report(self.generation, x.copy(), loss, np.full(x.shape, np.nan), unknown)

    def _outcome(self, status: Status, message: str) -> Outcome:
        return Outcome(self.best_x.copy(), self.best_loss, status, message, self.generation)


def library() -> Any:
    """Return the module `cma`.

    Raises:
        MissingExtra: it is not installed.
    """
    try:
        import cma
    except ModuleNotFoundError as error:
        raise MissingExtra(
            "optimizer cma_es needs the package 'cma', which is not installed: pip install 'cqrun[evo]'"
        ) from error
    return cma


def _listed(reasons: Iterable[tuple[str, Any]]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in reasons)
