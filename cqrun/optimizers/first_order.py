"""Steps along gradients: clipping, masks, mini-batches, bounds, half steps after failed trials, exact resume.

A method has two parts: the direction of its steps (Adam, SGD), and the merit that steps lower (the loss, or an
augmented Lagrangian of it).
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np
from pydantic import Field

from cqrun.optimizers.base import Optimizer, Outcome, Problem, Session, Status, TrialFailed, one_blas_thread
from cqrun.plugin.contract import Array

HALVINGS = 5
"""How often in a row a failed trial halves the step before the run fails."""

MEMORY = "memory."
NOT_STARTED = -1


@dataclass(frozen=True)
class DescentState:
    """Everything the next iteration depends on.

    Args:
        iteration: number of the last good point; -1 before the first.
        x, loss, grad: that point (n,), f and gradient (n,) there.
        step: what to subtract from x (n,), before `scale`.
        scale: 1, halved by each failed trial.
        failures: how many there were since that point.
        best_x, best_loss: the best point so far.
        queue: parts of the data not yet drawn in this epoch.
        rng: state of the bit generator as JSON.
        memory: the optimizer's own (n,) vectors by name.
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
    """What the steps lower: evaluated, remembered and judged.

    An `answer` is what an evaluation gave: f (), the gradient g (n,) that steps follow, terms (k,), and more.
    """

    @abstractmethod
    def memory(self, x: Array) -> dict[str, Array]:
        """Return what is remembered at the start x (n,)."""

    @abstractmethod
    def evaluate(self, x: Array, batch: tuple[int, ...] | None, memory: dict[str, Array]) -> dict[str, Array]:
        """Return the answer at x (n,); TrialFailed where it blows up."""

    @abstractmethod
    def learn(self, iteration: int, answer: dict[str, Array], memory: dict[str, Array]) -> dict[str, Array]:
        """Return the memory after an iteration's evaluation."""

    @abstractmethod
    def step(self, usual: Array, answer: dict[str, Array]) -> Array:
        """Return what to subtract from x (n,) after an evaluation, given what the direction would have."""

    @abstractmethod
    def better(self, state: DescentState, answer: dict[str, Array]) -> bool:
        """Say whether an evaluation is the best so far."""

    @abstractmethod
    def columns(self, x: Array, answer: dict[str, Array]) -> dict[str, float]:
        """Return the history's columns beside the loss."""

    @abstractmethod
    def may_converge(self, memory: dict[str, Array]) -> bool:
        """Say whether a search may end at the last point once its gradient vanishes."""

    @abstractmethod
    def concluded(self, outcome: Outcome) -> Outcome:
        """Return the outcome with the merit's own verdict on it."""


class FirstOrder(Optimizer):
    """First-order descent: x <- clip(x - step, lower, upper), one gradient an iteration."""

    max_iterations: int = Field(100, ge=1, description="iterations at most")
    learning_rate: float = Field(gt=0, description="step length in scaled coordinates")
    decay: float = Field(0.0, ge=0, description="the learning rate of iteration k is divided by 1 + decay k")
    batch_size: int | None = Field(
        None, ge=1, description="parts of the data (recordings) in a mini-batch; default all of them"
    )
    clip: float | None = Field(
        None, gt=0, description="a longer gradient is shortened to this Euclidean norm, scaled coordinates"
    )
    clip_entries: float | None = Field(
        None, gt=0, description="every entry of the gradient is cut to this size, before `clip` (ChainQueen: 1)"
    )
    mask: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="chance of an entry of the gradient to count as zero, drawn anew each iteration (ChainQueen: 0.2)",
    )
    gradient_tolerance: float = Field(
        0.0,
        ge=0,
        description="converged when no component of the projected full gradient is larger; 0: never",
    )

    @property
    def draws(self) -> bool:
        """Whether gradients are masked, or mini-batches drawn."""
        return self.mask > 0 or self.batch_size is not None

    @abstractmethod
    def memory_names(self) -> tuple[str, ...]:
        """Return the names of the (n,) vectors the method remembers; they start at zero."""

    @abstractmethod
    def direction(self, iteration: int, grad: Array, memory: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Return what to subtract from x at learning rate 1 (n,), and the new vectors of the memory."""

    @abstractmethod
    def merit(self, problem: Problem) -> Merit:
        """Return what the steps lower."""

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
                return self._outcome(state, "stopped", f"asked to stop after iteration {state.iteration}")
            try:
                state, terms = self._advance(state, problem, merit)
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
            memory={name: np.zeros_like(x) for name in self.memory_names()} | merit.memory(x),
        )

    def _advance(self, state: DescentState, problem: Problem, merit: Merit) -> tuple[DescentState, dict[str, float]]:
        """Return the state after one good trial and the terms of its loss; TrialFailed changes nothing."""
        x = np.clip(state.x - state.step, problem.lower, problem.upper)
        rng = _rng_from_text(state.rng)
        batch, queue = self._draw(state, rng, problem)
        answer = merit.evaluate(x, batch, state.memory)
        loss, grad, iteration = float(answer["f"]), answer["g"], state.iteration + 1
        direction, moments = self.direction(iteration, self._tamed(grad, rng), state.memory)
        memory = merit.learn(iteration, answer, state.memory | moments)
        rate = self.learning_rate / (1.0 + self.decay * iteration)
        wanted = merit.step(state.scale * (rate * direction), answer)
        better = self._changes(problem) or merit.better(state, answer)  # losses of other data do not compare
        advanced = replace(
            state,
            iteration=iteration,
            x=x,
            loss=loss,
            grad=grad,
            step=x - np.clip(x - wanted, problem.lower, problem.upper),  # a halved step is half of what was made
            failures=0,
            best_x=x if better else state.best_x,
            best_loss=loss if better else state.best_loss,
            queue=queue,
            rng=_rng_text(rng),
            memory=memory,
        )
        return advanced, merit.columns(x, answer)

    def _draw(
        self, state: DescentState, rng: np.random.Generator, problem: Problem
    ) -> tuple[tuple[int, ...] | None, Array]:
        """Return the next mini-batch (None: all) and what is left of the epoch."""
        if problem.stochastic:
            return (state.iteration + 1,), state.queue
        if self.batch_size is None:
            return None, state.queue
        queue = state.queue if state.queue.size else rng.permutation(problem.n_batches)
        drawn, left = queue[: self.batch_size], queue[self.batch_size :]
        return tuple(int(i) for i in np.sort(drawn)), left

    def _tamed(self, grad: Array, rng: np.random.Generator) -> Array:
        """Return the gradient (n,) that steps are made of: clipped, then masked."""
        if self.clip_entries is not None:
            grad = np.clip(grad, -self.clip_entries, self.clip_entries)
        if self.clip is not None and (norm := float(np.sqrt(np.sum(grad**2)))) > self.clip:
            grad = grad * (self.clip / norm)
        if self.mask > 0:
            grad = np.where(rng.random(grad.shape) < self.mask, 0.0, grad)
        return grad

    def _changes(self, problem: Problem) -> bool:
        """Say whether an iteration has another loss than the one before it."""
        return self.batch_size is not None or problem.stochastic

    def _converged(self, state: DescentState, problem: Problem) -> bool:
        if state.iteration == NOT_STARTED or self._changes(problem) or self.gradient_tolerance == 0:
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
