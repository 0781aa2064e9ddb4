"""Descent of a loss without constraints: the base of Adam and SGD, and of a plug-in that has a direction of its own."""

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

    def memory(self, x: Array) -> dict[str, Array]:
        """Return nothing: a loss remembers nothing."""
        return {}

    def evaluate(self, x: Array, batch: tuple[int, ...] | None, memory: dict[str, Array]) -> dict[str, Array]:
        """Return f, its gradient and the terms at x; TrialFailed where it blows up."""
        return checked_value_and_grad(self.problem, x, batch)

    def learn(self, iteration: int, answer: dict[str, Array], memory: dict[str, Array]) -> dict[str, Array]:
        """Return the memory as it is."""
        return memory

    def step(self, usual: Array, answer: dict[str, Array]) -> Array:
        """Return the direction's own step (n,)."""
        return usual

    def better(self, state: DescentState, answer: dict[str, Array]) -> bool:
        """Say whether the loss is lower than all before."""
        return float(answer["f"]) < state.best_loss

    def columns(self, x: Array, answer: dict[str, Array]) -> dict[str, float]:
        """Return the terms of the loss."""
        return terms_of(self.problem, answer["terms"])

    def may_converge(self, memory: dict[str, Array]) -> bool:
        """Say yes."""
        return True

    def concluded(self, outcome: Outcome) -> Outcome:
        """Return the outcome as it is."""
        return outcome


class Descent(FirstOrder):
    """Base of methods without constraints; what is left to say is `memory_names` and `direction`."""

    @final
    def merit(self, problem: Problem) -> Merit:
        """Return the loss."""
        return LossMerit(problem)

    def require(self, problem: Problem) -> None:
        """Refuse mini-batches with more parts than there are, or of data that is drawn anew anyway."""
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
