"""Steps along gradients: clipping, masks, mini-batches, bounds, half steps after failed trials, exact resume.

A method has two parts: the direction of its steps (Adam, SGD), and the merit function that they reduce (the loss, or
its augmented Lagrangian).
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from pydantic import Field

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
    one_blas_thread,
)
from cqrun.plugin.contract import Array

HALVINGS = 5
"""How many times in a row a failed trial halves the step before the run fails."""

MEMORY = "memory."


@dataclass(frozen=True)
class DescentState:
    """Everything on which the next iteration depends.

    Args:
        iteration: number of the last good point; -1 before the first.
        x, loss, grad: that point (n,), and f and its gradient (n,) there.
        step: next step, which is subtracted from x (n,).
        scale: factor of the step: 1, halved by each failed trial.
        failures: number of failed trials since that point.
        best_x, best_loss: the best point so far.
        queue: parts of the data not yet drawn in this epoch.
        rng: state of the bit generator as JSON.
        memory: arrays that the method and its merit function remember, by name.
    """

    iteration: int
    x: Array
    loss: float
    grad: Array
    step: Array
    scale: float
    failures: int
    best_x: Array
    best_loss: float
    queue: Array
    rng: str
    memory: dict[str, Array] = field(default_factory=dict)

    def arrays(self) -> dict[str, Array]:
        """Return the state as named arrays."""
        plain = {name: np.asarray(value) for name, value in vars(self).items() if name != "memory"}
        return plain | {MEMORY + name: value for name, value in self.memory.items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Array]) -> DescentState:
        """Return the state that `arrays()` gave."""
        return cls(
            iteration=int(arrays["iteration"]),
            x=arrays["x"],
            loss=float(arrays["loss"]),
            grad=arrays["grad"],
            step=arrays["step"],
            scale=float(arrays["scale"]),
            failures=int(arrays["failures"]),
            best_x=arrays["best_x"],
            best_loss=float(arrays["best_loss"]),
            queue=arrays["queue"],
            rng=str(arrays["rng"]),
            memory={n.removeprefix(MEMORY): a for n, a in arrays.items() if n.startswith(MEMORY)},
        )


class Merit(ABC):
    """Function that the steps reduce, with its memory.

    An `answer` is the result of an evaluation: f (), the gradient g (n,) for the steps, terms (k,), and more.
    """

    @abstractmethod
    def initial_memory(self, x: Array) -> dict[str, Array]:
        """Return the memory at the start x (n,)."""

    @abstractmethod
    def evaluate(self, x: Array, batch: tuple[int, ...] | None, memory: dict[str, Array]) -> dict[str, Array]:
        """Return the answer at x (n,); TrialFailed if the rollout blows up."""

    @abstractmethod
    def update_memory(self, iteration: int, answer: dict[str, Array], memory: dict[str, Array]) -> dict[str, Array]:
        """Return the memory after an evaluation."""

    @abstractmethod
    def step(self, usual: Array, answer: dict[str, Array]) -> Array:
        """Return the step to subtract from x (n,) after an evaluation, given the step along the direction (n,)."""

    @abstractmethod
    def better(self, state: DescentState, answer: dict[str, Array]) -> bool:
        """Return whether an evaluation is the best so far."""

    @abstractmethod
    def history_columns(self, x: Array, answer: dict[str, Array]) -> dict[str, float]:
        """Return the columns of the history besides the loss."""

    @abstractmethod
    def may_converge(self, memory: dict[str, Array]) -> bool:
        """Return whether the search may end at the last point if the gradient vanishes there."""

    @abstractmethod
    def concluded(self, outcome: Outcome) -> Outcome:
        """Return the outcome with the status that the merit function gives it."""


class FirstOrder(Optimizer):
    """First-order descent: x <- clip(x - step, lower, upper), with one gradient per iteration."""

    max_iterations: int = Field(100, ge=1, description="maximum number of iterations")
    learning_rate: float = Field(gt=0, description="step length in scaled coordinates")
    decay: float = Field(0.0, ge=0, description="the learning rate of iteration k is divided by 1 + decay k")
    batch_size: int | None = Field(
        None, ge=1, description="number of parts of the data (recordings) in a mini-batch; all of them if absent"
    )
    clip: float | None = Field(
        None, gt=0, description="a longer gradient is shortened to this Euclidean norm, in scaled coordinates"
    )
    clip_entries: float | None = Field(
        None, gt=0, description="every entry of the gradient is clipped to this size, before `clip` (ChainQueen: 1)"
    )
    mask: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="probability that an entry of the gradient is set to zero in an iteration (ChainQueen: 0.2)",
    )
    gradient_tolerance: float = Field(
        0.0,
        ge=0,
        description="converged when no component of the projected gradient is larger; 0: never",
    )

    @property
    def draws(self) -> bool:
        """Whether gradients are masked or mini-batches drawn."""
        return self.mask > 0 or self.batch_size is not None

    @abstractmethod
    def memory_names(self) -> tuple[str, ...]:
        """Return the names of the (n,) vectors that the method remembers; they start at zero."""

    @abstractmethod
    def direction(self, iteration: int, grad: Array, memory: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Return the step to subtract from x at learning rate 1 (n,), and the new vectors."""

    @abstractmethod
    def merit(self, problem: Problem) -> Merit:
        """Return the function that the steps reduce."""

    @final
    def minimise(self, problem: Problem, session: Session) -> Outcome:
        """Minimise with exact resume through the session's state file; UsageError as `require`."""
        self.require(problem)
        merit = self.merit(problem)
        with one_blas_thread():
            outcome = self._descend(problem, merit, session)
        return merit.concluded(outcome)

    def _descend(self, problem: Problem, merit: Merit, session: Session) -> Outcome:
        saved = session.restore()
        state = self._begin(problem, merit, session.seed) if saved is None else DescentState.from_arrays(saved)
        while True:
            if self._converged(state, problem) and merit.may_converge(state.memory):
                return self._outcome(state, "converged", "the projected gradient is within its tolerance")
            if state.iteration >= self.max_iterations:
                return self._outcome(state, "iteration_limit", f"{self.max_iterations} iterations, the limit")
            if session.should_stop():
                return self._outcome(state, "stopped", asked_to_stop(state.iteration))
            try:
                state, terms = self._advance(state, problem, merit)
            except StopAsked:
                return self._outcome(state, "stopped", asked_to_stop(state.iteration))
            except TrialFailed as failure:
                session.note(f"iteration {state.iteration + 1}: failed trial: {failure}")
                if state.iteration == NOT_STARTED:
                    return self._outcome(state, "failed", f"the start itself fails: {failure}")
                if state.failures >= HALVINGS:
                    return self._outcome(state, "failed", f"{failure} (after {HALVINGS} halvings of the step)")
                state = replace(state, scale=0.5 * state.scale, step=0.5 * state.step, failures=state.failures + 1)
                session.note(f"back to iteration {state.iteration}, step times {state.scale:g}")
            else:
                session.report(state.iteration, state.x, state.loss, state.grad, terms)
            session.save(state.arrays())

    def _begin(self, problem: Problem, merit: Merit, seed: int) -> DescentState:
        x = np.clip(np.asarray(problem.start, float), problem.lower, problem.upper)
        zeros = np.zeros_like(x)
        return DescentState(
            iteration=NOT_STARTED,
            x=x,
            loss=np.inf,
            grad=zeros,
            step=zeros,
            scale=1.0,
            failures=0,
            best_x=x,
            best_loss=np.inf,
            queue=np.zeros(0, np.int64),
            rng=_rng_text(np.random.default_rng(seed)),
            memory={name: np.zeros_like(x) for name in self.memory_names()} | merit.initial_memory(x),
        )

    def _advance(self, state: DescentState, problem: Problem, merit: Merit) -> tuple[DescentState, dict[str, float]]:
        """Return the state after one good trial and the terms of its loss; TrialFailed changes nothing."""
        x = np.clip(state.x - state.step, problem.lower, problem.upper)
        rng = _rng_from_text(state.rng)
        batch, queue = self._draw(state, rng, problem)
        answer = merit.evaluate(x, batch, state.memory)
        loss, grad, iteration = float(answer["f"]), answer["g"], state.iteration + 1
        direction, moments = self.direction(iteration, self._clipped_and_masked(grad, rng), state.memory)
        memory = merit.update_memory(iteration, answer, state.memory | moments)
        rate = self.learning_rate / (1.0 + self.decay * iteration)
        step = merit.step(state.scale * (rate * direction), answer)
        better = self._loss_changes(problem) or merit.better(state, answer)  # losses of different data do not compare
        advanced = replace(
            state,
            iteration=iteration,
            x=x,
            loss=loss,
            grad=grad,
            step=x - np.clip(x - step, problem.lower, problem.upper),  # so that a half step is half of the actual one
            failures=0,
            best_x=x if better else state.best_x,
            best_loss=loss if better else state.best_loss,
            queue=queue,
            rng=_rng_text(rng),
            memory=memory,
        )
        return advanced, merit.history_columns(x, answer)

    def _draw(
        self, state: DescentState, rng: np.random.Generator, problem: Problem
    ) -> tuple[tuple[int, ...] | None, Array]:
        """Return the next mini-batch (None: all) and the rest of the epoch."""
        if problem.stochastic:
            return (state.iteration + 1,), state.queue
        if self.batch_size is None:
            return None, state.queue
        queue = state.queue if state.queue.size else rng.permutation(problem.n_batches)
        drawn, rest = queue[: self.batch_size], queue[self.batch_size :]
        return tuple(int(i) for i in np.sort(drawn)), rest

    def _clipped_and_masked(self, grad: Array, rng: np.random.Generator) -> Array:
        """Return the gradient (n,) for steps: clipped, then masked."""
        if self.clip_entries is not None:
            grad = np.clip(grad, -self.clip_entries, self.clip_entries)
        if self.clip is not None and (norm := float(np.sqrt(np.sum(grad**2)))) > self.clip:
            grad = grad * (self.clip / norm)
        if self.mask > 0:
            grad = np.where(rng.random(grad.shape) < self.mask, 0.0, grad)
        return grad

    def _loss_changes(self, problem: Problem) -> bool:
        """Return whether the loss function differs from iteration to iteration."""
        return self.batch_size is not None or problem.stochastic

    def _converged(self, state: DescentState, problem: Problem) -> bool:
        if state.iteration == NOT_STARTED or self._loss_changes(problem) or self.gradient_tolerance == 0:
            return False
        projected = state.x - np.clip(state.x - state.grad, problem.lower, problem.upper)
        return bool(np.max(np.abs(projected)) <= self.gradient_tolerance)

    def _outcome(self, state: DescentState, status: Status, message: str) -> Outcome:
        return Outcome(state.best_x.copy(), state.best_loss, status, message, max(state.iteration, 0))


def _rng_text(rng: np.random.Generator) -> str:
    return json.dumps(rng.bit_generator.state)


def _rng_from_text(text: str) -> np.random.Generator:
    rng = np.random.default_rng(0)
    rng.bit_generator.state = json.loads(text)
    return rng
