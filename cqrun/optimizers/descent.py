"""Descent of a loss without constraints: the base of Adam and SGD, and of plug-ins with their own direction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from cqrun.errors import UsageError
from cqrun.optimizers.base import Outcome, Problem, checked_value_and_grad, terms_of
from cqrun.optimizers.first_order import DescentState, FirstOrder, Merit
from cqrun.plugin.contract import Array


@dataclass(frozen=True)
class LossMerit(Merit):
    """The loss itself, of all data or of a mini-batch."""

    problem: Problem

    def initial_memory(self, x: Array) -> dict[str, Array]:
        """Return an empty memory: the loss needs none."""
        return {}

    def evaluate(self, x: Array, batch: tuple[int, ...] | None, memory: dict[str, Array]) -> dict[str, Array]:
        """Return f (), its gradient g (n,) and the terms at x; TrialFailed if the rollout blows up."""
        return checked_value_and_grad(self.problem, x, batch)

    def update_memory(self, iteration: int, answer: dict[str, Array], memory: dict[str, Array]) -> dict[str, Array]:
        """Return the memory unchanged."""
        return memory

    def step(self, usual: Array, answer: dict[str, Array]) -> Array:
        """Return the step along the direction (n,)."""
        return usual

    def better(self, state: DescentState, answer: dict[str, Array]) -> bool:
        """Return whether the loss is the lowest so far."""
        return float(answer["f"]) < state.best_loss

    def history_columns(self, x: Array, answer: dict[str, Array]) -> dict[str, float]:
        """Return the terms of the loss."""
        return terms_of(self.problem, answer["terms"])

    def may_converge(self, memory: dict[str, Array]) -> bool:
        """Return true: a loss sets no further condition."""
        return True

    def concluded(self, outcome: Outcome) -> Outcome:
        """Return the outcome unchanged."""
        return outcome


class Descent(FirstOrder):
    """Base of methods without constraints; a method defines `memory_names` and `direction`."""

    @final
    def merit(self, problem: Problem) -> Merit:
        """Return the loss."""
        return LossMerit(problem)

    def require(self, problem: Problem) -> None:
        """Raise UsageError for mini-batches that are too large, or that are combined with fresh goals."""
        if self.batch_size is not None and problem.stochastic:
            raise UsageError(
                "batch_size takes parts of a fixed set, but the objective draws fresh goals at "
                "every iteration: remove one of the two"
            )
        if self.batch_size is not None and self.batch_size > problem.n_batches:
            raise UsageError(
                f"batch_size is {self.batch_size}, but the data falls into {problem.n_batches} parts (recordings, "
                f"goals): give at most {problem.n_batches}"
            )
