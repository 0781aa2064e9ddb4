"""Learning of control as an optimization problem: the mean loss of episodes as a function of the learned numbers.

An episode is one rollout with the policy and its own goals. Goals are drawn once, or again at every iteration
(`episodes.fresh`); the same seed draws the same goals. The rollouts of an evaluation run in parallel and share the
threads; the results are bit-for-bit identical for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cqrun.design.params import REGULARISER
from cqrun.errors import UsageError
from cqrun.learning.agent import Agent, Attempt, Goals, Mix, Values
from cqrun.optimizers.base import TrialFailed
from cqrun.optimizers.constrained import ReplayedConstrained
from cqrun.plugin.contract import Array
from cqrun.running.gradient_memory import gradients_at_once
from cqrun.running.runs import optimizer_of
from cqrun.running.side_by_side import Effort, side_by_side, the_value, trial
from cqrun.scene.schema import Scene

UNSEEN = 1_000_003
"""First number of the seeds of unseen goals, far from the number of any iteration."""


def has_episodes(scene: Scene) -> bool:
    """Return whether a scene has a controller, and an objective or constraints for it."""
    return scene.controller is not None and bool(scene.objective or scene.constraints)


def loss_alone(attempt: Attempt) -> list[Mix]:
    """Return the loss as the only function of an episode."""
    return [Mix(1.0, {})]


class EpisodeProblem:
    """A `Problem` (optimizers/base.py) over the episodes of a scene.

    Args:
        agent: the agent; the problem starts at the scene's start values, even if the agent has a trained controller.
        threads: number of threads.

    Attributes:
        built, params: the agent's scene, and the numbers to learn.
        summands: names of the terms of the loss.
        observations: (T, Z) inputs of the controller, for each episode of the last evaluation.
        interrupt: called before every rollout; it raises StopAsked if the run was asked to stop.
    """

    def __init__(self, agent: Agent, *, threads: int = 1) -> None:
        self.agent, self.threads = agent, threads
        self.built, self.params = agent.built, agent.params
        scene = self.built.scene
        self.start = self.params.start
        self.lower, self.upper = self.params.bounds
        self.stochastic = scene.episodes.fresh and any(g.drawn for g in scene.goals.values())
        self.n_batches = 1 if self.stochastic else self.n_episodes
        self.summands = [*scene.objective, *[REGULARISER] * self.params.regularised]
        self.term_names: Sequence[str] = [*self.summands, "growth_at"]
        constraints = scene.constraints
        self.constraint_names: Sequence[str] = list(constraints)
        self.scales = np.array([c.scale for c in constraints.values()])
        self.c_low = np.array([c.low for c in constraints.values()]) / self.scales
        self.c_high = np.array([c.high for c in constraints.values()]) / self.scales
        self.effort = Effort()
        self.interrupt: Callable[[], None] = lambda: None
        self._terms = np.full(len(self.term_names), np.nan)
        self.observations: list[Array] = []

    # --- regularisers of the unknowns, which an agent does not know ---------------------------------------------

    def attempt(self, values: Values, goals: Goals, threads: int) -> Attempt:
        """Run one episode forward; its loss and terms include the regularisers of the unknowns."""
        return self._regularised(self.agent.attempt(values, goals, threads), values)

    def attempt_with_gradients(
        self, values: Values, goals: Goals, threads: int, budget: int, mixes: Callable[[Attempt], Sequence[Mix]]
    ) -> tuple[Attempt, list[dict[str, Array]]]:
        """Run one episode forward and backward; its loss and gradients include the regularisers of the unknowns."""
        functions: list[Mix] = []

        def collected(attempt: Attempt) -> Sequence[Mix]:
            functions.extend(mixes(attempt))
            return functions

        attempt, gradients = self.agent.attempt_with_gradients(values, goals, threads, budget, collected)
        for mix, gradient in zip(functions, gradients, strict=True):
            for path, bar in self.params.departure_vjp(values, mix.loss).items():
                gradient[path] = gradient[path] + bar
        return self._regularised(attempt, values), gradients

    def _regularised(self, attempt: Attempt, values: Values) -> Attempt:
        if not self.params.regularised:
            return attempt
        departure = self.params.departure(values)
        return replace(attempt, loss=attempt.loss + departure, terms=attempt.terms | {REGULARISER: departure})

    # --- goals ------------------------------------------------------------------------------------------------

    @property
    def n_episodes(self) -> int:
        """Number of episodes in an iteration; one if no goal is drawn."""
        scene = self.built.scene
        return scene.episodes.count if any(g.drawn for g in scene.goals.values()) else 1

    def goals(self, batch: tuple[int, ...] | None) -> list[Goals]:
        """Return the goals of the episodes in a batch; for fresh goals the batch is (k,), the iteration."""
        if self.stochastic:
            (k,) = batch or (0,)
            return [self._draw(k, e) for e in range(self.n_episodes)]
        return [self._draw(0, e) for e in (range(self.n_episodes) if batch is None else batch)]

    def unseen(self) -> list[Goals]:
        """Return the goals for the test of the result."""
        return [self._draw(UNSEEN, e) for e in range(self.built.scene.episodes.unseen)]

    def _draw(self, iteration: int, episode: int) -> Goals:
        scene = self.built.scene
        rng = np.random.default_rng([scene.episodes.seed, iteration, episode])
        return {name: goal.draw(rng) for name, goal in scene.goals.items()}

    # --- the problem ----------------------------------------------------------------------------------------------

    def values(self, x: Array) -> dict[str, Array]:
        """Return the controller's parameters and the unknowns by path."""
        return self.params.unpack(x)

    def value_and_grad(self, x: Array, batch: tuple[int, ...] | None = None) -> tuple[float, Array]:
        """Return the mean loss of a batch of episodes and its gradient (n,)."""
        attempts, (gradient,) = self._swept(x, self.goals(batch), loss_alone)
        return float(np.mean([a.loss for a in attempts])), gradient

    def _swept(
        self, x: Array, goals: Sequence[Goals], mixes: Callable[[Attempt], Sequence[Mix]]
    ) -> tuple[list[Attempt], list[Array]]:
        """Run episodes forward and backward at x; return them and the gradients (n,) of the functions' means."""
        values = self.values(x)
        with trial(self.params, x):
            attempts, gradients = self.attempts_with_gradients(values, goals, mixes)
        self._record(attempts)
        return attempts, [self.params.gradient(x, gradient) for gradient in gradients]

    def attempts_with_gradients(
        self, values: Values, goals: Sequence[Goals], mixes: Callable[[Attempt], Sequence[Mix]] = loss_alone
    ) -> tuple[list[Attempt], list[dict[str, Array]]]:
        """Run episodes forward and backward in parallel.

        Args:
            values: the controller's parameters, and any other numbers that gradients reach, by path.
            goals: goals of each episode.
            mixes: returns the functions of an episode to differentiate; its loss if not given.

        Returns:
            The episodes, and for each function the gradient of its mean by path.

        Raises:
            RolloutError: one blows up.
        """
        at_once = gradients_at_once([self.agent.model] * len(goals), self.threads)
        budget = self.agent.model.memory_budget // at_once

        def task(goal: Goals) -> Callable[[int], tuple[Attempt, list[dict[str, Array]]]]:
            def run(threads: int) -> tuple[Attempt, list[dict[str, Array]]]:
                self.interrupt()
                return self.attempt_with_gradients(values, goal, threads, budget, mixes)

            return run

        results = side_by_side([task(goal) for goal in goals], self.threads, at_once)
        for attempt, _ in results:
            self.effort.add(attempt.effort)
        functions = zip(*(gradients for _, gradients in results), strict=True)
        means = [{path: np.mean([g[path] for g in each], axis=0) for path in values} for each in functions]
        return [attempt for attempt, _ in results], means

    def value(self, x: Array, batch: tuple[int, ...] | None = None) -> float:
        """Return the mean loss of a batch of episodes."""
        return the_value(self.values_at([x], batch))

    def values_at(self, points: Sequence[Array], batch: tuple[int, ...] | None = None) -> list[float | TrialFailed]:
        """Return the mean loss at every point, or its failed trial; the rollouts run in parallel."""
        goals = self.goals(batch)

        def task(x: Array, goal: Goals) -> Callable[[int], Attempt | TrialFailed]:
            def run(threads: int) -> Attempt | TrialFailed:
                self.interrupt()
                try:
                    with trial(self.params, x):
                        return self.attempt(self.values(x), goal, threads)
                except TrialFailed as failure:
                    return failure

            return run

        results = side_by_side([task(x, goal) for x in points for goal in goals], self.threads)
        out: list[float | TrialFailed] = []
        for p in range(len(points)):
            at_point = results[p * len(goals) : (p + 1) * len(goals)]
            failures = [a for a in at_point if isinstance(a, TrialFailed)]
            done = [a for a in at_point if isinstance(a, Attempt)]
            out.append(failures[0] if failures else float(np.mean([a.loss for a in done])))
            if len(points) == 1 and not failures:
                self._record(done)
        return out

    # --- constraints: means over episodes, divided by their scales ----------------------------------------------------

    def values_and_constraints(self, x: Array) -> tuple[float, Array]:
        """Return the mean loss and the constraints (m,) by forward rollouts."""
        values = self.values(x)

        def task(goal: Goals) -> Callable[[int], Attempt]:
            def run(threads: int) -> Attempt:
                self.interrupt()
                return self.attempt(values, goal, threads)

            return run

        with trial(self.params, x):
            attempts = side_by_side([task(goal) for goal in self.goals(None)], self.threads)
        self._record(attempts)
        return float(np.mean([a.loss for a in attempts])), self._constraints(attempts)

    def gradients_and_constraints(self, x: Array) -> tuple[float, Array, Array, Array]:
        """Return the mean loss, its gradient (n,), the constraints (m,) and their Jacobian (m, n)."""
        each = [Mix(0.0, {name: 1.0 / scale}) for name, scale in zip(self.constraint_names, self.scales, strict=True)]
        attempts, (g, *rows) = self._swept(x, self.goals(None), lambda attempt: [Mix(1.0, {}), *each])
        J = np.array(rows).reshape(-1, len(x))
        return float(np.mean([a.loss for a in attempts])), g, self._constraints(attempts), J

    def lagrangian(self, x: Array, weigh: Callable[[Array], Array]) -> tuple[float, Array, Array]:
        """Return the mean loss, the constraints c (m,), and the gradient (n,) of loss + weigh(c).c, in one sweep."""
        goals = self.goals(None)
        if len(goals) > 1:  # the weights depend on all episodes
            _, c = self.values_and_constraints(x)
            weights = weigh(c)

        def mixed(attempt: Attempt) -> list[Mix]:
            w = weigh(self._constraints([attempt])) if len(goals) == 1 else weights
            return [Mix(1.0, dict(zip(self.constraint_names, w / self.scales, strict=True)))]

        attempts, (g,) = self._swept(x, goals, mixed)
        return float(np.mean([a.loss for a in attempts])), self._constraints(attempts), g

    def bounds_in_words(self, below: Array, above: Array) -> str:
        """Return a text with the unknowns at a bound, from those at their lower and at their upper one (n,)."""
        return self.params.bounds_in_words(below, above)

    def _constraints(self, attempts: Sequence[Attempt]) -> Array:
        return np.array([np.mean([a.constraints[n] for a in attempts]) for n in self.constraint_names]) / self.scales

    def _record(self, attempts: Sequence[Attempt]) -> None:
        """Store the terms' means, the time of the first gradient's fastest growth [s], and the observations."""
        means = [float(np.mean([a.terms[name] for a in attempts])) for name in self.summands]
        control = attempts[0].growth_at
        self._terms = np.array([*means, control * self.agent.matter.control_step if control >= 0 else np.nan])
        self.observations = [a.observations for a in attempts]

    def term_values(self) -> Array:
        """Return the terms at the last evaluation, in the order of `term_names`."""
        return self._terms

    def residuals(self, x: Array) -> Array:
        """Raise UsageError: an objective is not a sum of squares."""
        raise UsageError("least squares fits data; for an objective take adam, sgd, lbfgs or cma_es")

    def residuals_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Raise UsageError, as `residuals`."""
        raise UsageError("least squares fits data; for an objective take adam, sgd, lbfgs or cma_es")


def differentiated(problem: EpisodeProblem) -> int:
    """Return the number of functions of an episode whose gradients the scene's optimizer takes in one backward run."""
    optimizer = optimizer_of(problem.built.scene)
    if not optimizer.gradients:
        return 0
    return 1 + (len(problem.constraint_names) if isinstance(optimizer, ReplayedConstrained) else 0)
