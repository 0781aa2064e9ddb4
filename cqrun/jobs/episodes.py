"""Learning to act, as an optimizer sees it: the mean loss of episodes, by a controller's parameters and unknowns.

An episode is one rollout under the policy, with its own goals. Goals are drawn once, or anew at every iteration
(`episodes.fresh`); the same seed draws the same. Rollouts of one evaluation run side by side on the cores, each on
one thread; a single one takes all threads. Neither changes a bit of the result.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from cqrun.contract import Array
from cqrun.controllers.policy import ControlPolicy, Limits
from cqrun.design.params import Block, Params, Plain
from cqrun.engine.model import LossBar, Records
from cqrun.engine.rollout import Rollout
from cqrun.errors import Problem, RolloutError, SceneError, UsageError
from cqrun.jobs.memory import least_budget, state_bytes
from cqrun.jobs.problem import Effort, make_params, side_by_side
from cqrun.objectives.term import Objective, Track, TrackBar
from cqrun.observers.matter import Matter
from cqrun.observers.observer import Observation
from cqrun.optimizers.base import TrialFailed
from cqrun.scene.build import Built
from cqrun.state import State

CONTROLLER = "controller."
"""Before the name of a block of the controller, as before a key path of the scene."""

UNSEEN = 1_000_003
"""Where the seeds of unseen goals begin, far from any iteration's."""

Goals = Mapping[str, Array]


@dataclass
class Attempt:
    """One rollout under the policy: its loss, the values of the terms, and the rollout."""

    loss: float
    terms: dict[str, float]
    rollout: Rollout
    track: Track


class EpisodeProblem:
    """A `Problem` (optimizers/base.py) over the episodes of a scene.

    Args:
        built: a scene with actuators, a controller and an objective.
        threads: cores to use.

    Raises:
        SceneError: something is missing, or names what is not there.
    """

    def __init__(self, built: Built, *, threads: int = 1) -> None:
        self.built, self.threads = built, threads
        scene = built.scene
        self.matter = matter_of(built)
        self.observation = self._bind(
            "observers", lambda: Observation.of({n: c.value for n, c in scene.observers.items()}, self.matter)  # type: ignore[misc]
        )
        self.objective = self._bind(
            "objective", lambda: Objective({n: c.value for n, c in scene.objective.items()}, self.matter)  # type: ignore[misc]
        )
        assert scene.controller is not None
        self.controller: Any = scene.controller.value
        drive = built.assembly.actuation
        self.limits = Limits(drive.low, drive.high, drive.change)
        rows = sparse.vstack([self.observation.rows, self.objective.rows]).tocsr()
        self.model = replace(built.model, probe=sparse.csr_array(rows))
        self.params = self._params()
        self.start = self.params.start
        self.lower, self.upper = self.params.bounds
        self.stochastic = scene.episodes.fresh and any(g.drawn for g in scene.goals.values())
        self.n_batches = 1 if self.stochastic else self.n_episodes
        self.term_names: Sequence[str] = [*scene.objective, "growth_at"]
        self.effort = Effort()
        self.interrupt: Callable[[], None] = lambda: None
        self._terms = np.full(len(self.term_names), np.nan)

    def _bind(self, key: str, make: Callable[[], Any]) -> Any:
        try:
            return make()
        except UsageError as error:
            raise SceneError([Problem(self.built.scene.where(key), key, str(error))]) from error

    def _params(self) -> Params:
        scene = self.built.scene
        rng = np.random.default_rng([scene.seed])
        blocks = self._bind(
            "controller",
            lambda: self.controller.blocks(
                self.observation.size, len(self.limits.low), self.model.n_controls, self.limits.low, self.limits.high,
                rng,
            ),
        )  # fmt: skip
        own: list[Block] = [Plain(CONTROLLER + b.name, b.lower, b.upper, False, np.array(b.initial)) for b in blocks]
        return Params((*own, *make_params(self.built).blocks))

    # --- goals ------------------------------------------------------------------------------------------------

    @property
    def n_episodes(self) -> int:
        """Episodes of an iteration: one where no goal is drawn."""
        scene = self.built.scene
        return scene.episodes.count if any(g.drawn for g in scene.goals.values()) else 1

    def goals(self, batch: tuple[int, ...] | None) -> list[Goals]:
        """Return the goals of the episodes in a batch: of the set, or where they are fresh of an iteration (k,)."""
        if self.stochastic:
            (k,) = batch or (0,)
            return [self._draw(k, e) for e in range(self.n_episodes)]
        return [self._draw(0, e) for e in (range(self.n_episodes) if batch is None else batch)]

    def unseen(self) -> list[Goals]:
        """Return the goals that the result is tested on."""
        return [self._draw(UNSEEN, e) for e in range(self.built.scene.episodes.unseen)]

    def _draw(self, iteration: int, episode: int) -> Goals:
        scene = self.built.scene
        rng = np.random.default_rng([scene.episodes.seed, iteration, episode])
        drawn = {}
        for name, goal in scene.goals.items():
            spread = np.array(goal.spread if goal.spread is not None else [0.0] * len(goal.position))
            drawn[name] = np.array(goal.position) + spread * rng.uniform(-1.0, 1.0, len(spread))
        return drawn

    # --- rollouts -----------------------------------------------------------------------------------------------

    def values(self, x: Array) -> dict[str, Array]:
        """Return the controller's parameters and the unknowns by path."""
        return self.params.unpack(x)

    def rollout(self, values: Mapping[str, Array], goals: Goals, threads: int, *, adjoint: bool = False) -> Rollout:
        """Return a rollout under the policy with these values; nothing is run yet."""
        parameters = {p.removeprefix(CONTROLLER): v for p, v in values.items() if p.startswith(CONTROLLER)}
        policy = ControlPolicy(
            self.observation, self.controller, parameters, self.limits, goals, self.matter.control_step, self.model.dim
        )
        inputs = self.built.assembly.inputs({p: v for p, v in values.items() if not p.startswith(CONTROLLER)})
        inputs.state.memory = np.zeros(policy.n_memory)
        return Rollout(self.model, inputs, threads=threads, adjoint=adjoint, policy=policy)

    def track(self, records: Records, activation: Array, goals: Goals) -> Track:
        """Return a run as the objective sees it."""
        k = self.observation.rows.shape[0]
        return Track(
            records.x[:, k:], records.v[:, k:], records.C[:, k:], records.F[:, k:], activation, goals,
            self.matter.control_step,
        )  # fmt: skip

    def attempt(
        self, values: Mapping[str, Array], goals: Goals, threads: int,
        observe: Callable[[int, State], None] | None = None,
    ) -> Attempt:  # fmt: skip
        """Run one episode forward."""
        rollout = self.rollout(values, goals, threads)
        track = self.track(rollout.run(observe), rollout.activation, goals)
        return Attempt(self.objective.loss(track), self.objective.values(track), rollout, track)

    def attempt_with_gradient(
        self, values: Mapping[str, Array], goals: Goals, threads: int, budget: int
    ) -> tuple[Attempt, dict[str, Array]]:
        """Run one episode forward and backward; return it and the gradient of its loss by path."""
        rollout = self.rollout(values, goals, threads, adjoint=True)
        rollout.model = replace(self.model, memory_budget=budget)
        found: list[Track] = []

        def loss_bar(records: Records, final: State) -> LossBar:
            found.append(self.track(records, rollout.activation, goals))
            return self._loss_bar(records, self.objective.loss_vjp(found[0]))

        _, inputs_bar = rollout.gradient(loss_bar)
        policy: Any = rollout.policy
        gradient = {CONTROLLER + name: bar for name, bar in policy.parameters_bar.items()}
        own = {p: v for p, v in values.items() if not p.startswith(CONTROLLER)}
        gradient |= self.built.assembly.gradient(own, inputs_bar)
        track = found[0]
        return Attempt(self.objective.loss(track), self.objective.values(track), rollout, track), gradient

    def _loss_bar(self, records: Records, bar: TrackBar) -> LossBar:
        k = self.observation.rows.shape[0]
        full = Records(*(np.zeros_like(a) for a in (records.x, records.v, records.C, records.F)))
        for name in ("x", "v", "C", "F"):
            part = getattr(bar, name)
            if part is not None:
                getattr(full, name)[:, k:] = part
        return LossBar(full, activation=bar.activation)

    # --- the problem ----------------------------------------------------------------------------------------------

    def value_and_grad(self, x: Array, batch: tuple[int, ...] | None = None) -> tuple[float, Array]:
        """Return the mean loss of a batch of episodes and its gradient (n,)."""
        values, goals = self.values(x), self.goals(batch)
        least = least_budget(state_bytes(self.model))
        at_once = max(1, min(self.threads, len(goals), self.model.memory_budget // least))
        budget = self.model.memory_budget // at_once

        def task(goal: Goals) -> Callable[[int], tuple[Attempt, dict[str, Array]]]:
            def run(threads: int) -> tuple[Attempt, dict[str, Array]]:
                self.interrupt()
                return self._guarded(x, lambda: self.attempt_with_gradient(values, goal, threads, budget))

            return run

        found = side_by_side([task(goal) for goal in goals], self.threads, at_once)
        for attempt, _ in found:
            self.effort.add(attempt.rollout)
        self._note([attempt for attempt, _ in found])
        total = {path: np.mean([gradient[path] for _, gradient in found], axis=0) for path in values}
        return float(np.mean([a.loss for a, _ in found])), self.params.gradient(x, total)

    def value(self, x: Array, batch: tuple[int, ...] | None = None) -> float:
        """Return the mean loss of a batch of episodes."""
        (found,) = self.values_at([x], batch)
        if isinstance(found, TrialFailed):
            raise found
        return found

    def values_at(self, points: Sequence[Array], batch: tuple[int, ...] | None = None) -> list[float | TrialFailed]:
        """Return the mean loss at every point, or how its trial failed; rollouts side by side."""
        goals = self.goals(batch)

        def task(x: Array, goal: Goals) -> Callable[[int], Attempt | TrialFailed]:
            def run(threads: int) -> Attempt | TrialFailed:
                self.interrupt()
                try:
                    return self._guarded(x, lambda: self.attempt(self.values(x), goal, threads))
                except TrialFailed as failure:
                    return failure

            return run

        found = side_by_side([task(x, goal) for x in points for goal in goals], self.threads)
        out: list[float | TrialFailed] = []
        for p in range(len(points)):
            own = found[p * len(goals) : (p + 1) * len(goals)]
            failures = [a for a in own if isinstance(a, TrialFailed)]
            done = [a for a in own if isinstance(a, Attempt)]
            out.append(failures[0] if failures else float(np.mean([a.loss for a in done])))
            if len(points) == 1 and not failures:
                self._note(done)
        return out

    def _guarded(self, x: Array, work: Callable[[], Any]) -> Any:
        try:
            return work()
        except RolloutError as error:
            raise TrialFailed(
                f"{error.reason}; {error.advice}", body=error.body, particle=error.particle, time=error.time,
                values=self.params.describe(x),
            ) from error  # fmt: skip

    def _note(self, attempts: Sequence[Attempt]) -> None:
        """Keep the mean of every term, and where the gradient of the first episode grew fastest [s]."""
        means = [float(np.mean([a.terms[name] for a in attempts])) for name in self.built.scene.objective]
        self._terms = np.array([*means, attempts[0].rollout.growth_at * self.matter.control_step])

    def term_values(self) -> Array:
        """Return the terms at the last evaluation, in the order of `term_names`."""
        return self._terms

    def residuals(self, x: Array) -> Array:
        """Refuse: an objective is no sum of squares."""
        raise UsageError("least squares fits data; for an objective take adam, sgd, lbfgs or cma_es")

    def residuals_and_jacobian(self, x: Array) -> tuple[Array, Array]:
        """Refuse, as `residuals`."""
        raise UsageError("least squares fits data; for an objective take adam, sgd, lbfgs or cma_es")


def matter_of(built: Built) -> Matter:
    """Return what observers and objectives may know of a scene."""
    scene, particles = built.scene, built.particles
    return Matter(
        x=particles.x,
        mass=built.assembly.inputs({}).fields.mass,
        size=np.array(scene.world.size),
        control_step=scene.time.control_step,
        n_controls=scene.time.control_steps,
        bodies={name: particles.of(name) for name in particles.names},
        groups={name: particles.groups(name) for name in particles.names},
        select=particles.inside,
        goals={name: len(goal.position) for name, goal in scene.goals.items()},
        n_actuators=len(built.assembly.actuation.parts),
        resolve=scene.resolve_path,
    )
