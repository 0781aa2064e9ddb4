"""A scene as a Gymnasium environment, for learners without gradients such as PPO (extra `rl`).

    env = cqrun.environment("scenes/control/finger.yaml")
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

A step is a control step. Observations are those of the scene's observers, or time if it has none. Actions are those of
a bounded controller: numbers in [-1, 1], mapped to the actuators' limits. The reward is the decrease of the loss in the
step, where the loss is that of a run that ends here and keeps its last record; so for any objective the rewards of an
episode sum to the total decrease. Scenes with constraints are refused. Unknowns have their start values, or in the
environment of a run, `cqrun.environment("results/arm/d47b0a4e3f21")`, the values that the run has found.

An episode that blows up ends there, and its rewards sum to less than those of any episode at any step so far: less by
the spread of these sums plus the size of its first loss. With a reward of zero, blowing up would pay if the loss grows
with time.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import build
from cqrun.controllers.linear_tanh import LinearTanh
from cqrun.controllers.policy import ControlPolicy
from cqrun.engine.model import Records
from cqrun.errors import MissingExtra, Problem, RolloutError, SceneError, UsageError
from cqrun.explain import listed
from cqrun.learning.agent import FILE, OBJECTIVE, Agent, Goals, Values
from cqrun.learning.replay import design_in, require_fitting
from cqrun.observers.clock import Clock
from cqrun.observers.track import Track
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Array
from cqrun.running.runs import scene_in
from cqrun.running.threads import checked_threads, cores
from cqrun.scene.load import load_scene
from cqrun.scene.plugin_files import plugins_allowed
from cqrun.scene.schema import Scene

try:
    import gymnasium
except ImportError as error:
    raise MissingExtra(
        f"an environment needs {error.name}, which is not installed: pip install 'cqrun[rl]' (its torch is "
        "several GB with CUDA: install a CPU build of torch first, see pytorch.org)"
    ) from None

NEEDED = {
    "actuators": "say what drives the body",
    "objective": "say what the motion is for",
}
"""What a scene must have to be an environment, and the advice where it is missing."""

CONSTRAINED = (
    "an environment does not support constraints: make them weighted terms of the objective, or remove them "
    "(-o constraints={})"
)


class SceneEnvironment(gymnasium.Env[Array, Array]):
    """A scene whose actuators the caller drives, one episode at a time.

    Args:
        scene: a scene with actuators and an objective; its controller, if it has one, is not used.
        threads: largest number of threads. Results do not depend on it.
        design: values of its unknowns and their followers by path; missing ones have their start values.
        source: the file of these values.

    Raises:
        SceneError: a section is missing, or there are constraints. UsageError: the design belongs to other bodies.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  the name and form that gymnasium wants

    def __init__(
        self, scene: Scene, threads: int = 1, design: Values | None = None, source: Path = Path()
    ) -> None:  # fmt: skip
        problems = {key: f"an environment needs it: {why}" for key, why in NEEDED.items() if not getattr(scene, key)}
        problems |= {"constraints": CONSTRAINED} if scene.constraints else {}
        if problems:
            raise SceneError([Problem(scene.where(key), key, message) for key, message in problems.items()])
        if not scene.observers:
            scene = scene.model_copy(update={"observers": {"clock": Chosen("clock", Clock())}})
        # a controller with outputs in [-1, 1], which the actions of `step` replace
        self.agent, self.threads = Agent(build(scene.with_plugin("controller", LinearTanh()))), threads
        self.design = {} if design is None else dict(design)
        require_fitting(source, self.design, self.agent.params)
        self.least = self.most = 0.0  # sums of rewards, at any step of any episode
        n, a = self.agent.observation.size, len(self.agent.limits.low)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (a,), np.float64)

    # --- gymnasium's interface ------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode with goals drawn from their ranges; return the observation and the goals."""
        super().reset(seed=seed)
        agent = self.agent
        self.goals = self._draw()
        self.rollout = agent.rollout({**agent.acting, **self.design}, self.goals, self.threads)
        policy: Any = self.rollout.policy
        self.policy: ControlPolicy = policy
        self.states, self.control = self.rollout.start[None].copy(), 0
        self.track = self._empty_track()
        self.first = self.loss = self._loss_if_it_ended()
        self.over = False
        return self._see(), {"goals": dict(self.goals)}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Run one control step; return (observation, reward, whether it blew up, whether time is over, facts).

        Raises:
            UsageError: there is no running episode, or the action has another shape or is not finite.
        """
        if not hasattr(self, "rollout") or self.over:
            raise UsageError("step: the episode is over, or none has begun; call reset() first")
        rollout, model, control = self.rollout, self.agent.model, self.control
        u = np.asarray(action, np.float64)
        if u.shape != self.action_space.shape:
            raise UsageError(f"step: an action has shape {self.action_space.shape}, not {u.shape}")
        if not np.isfinite(u).all():
            raise UsageError(f"step: an action has finite numbers, not {u}")
        rollout.activation[control], rollout.memory[control + 1] = self.policy.activate(
            np.clip(u, -1.0, 1.0), self.remembered, rollout.memory[control]
        )
        rollout.decided = control + 1
        try:
            rollout.advance(control * model.substeps, (control + 1) * model.substeps, self.states, keep=False)
        except RolloutError as error:
            self.over = True
            return self.observation, self._blow_up_reward(), True, False, {"failed": str(error), "loss": self.loss}
        self.control += 1
        before, self.loss = self.loss, self._loss_if_it_ended()
        so_far = self.first - self.loss
        self.least, self.most = min(self.least, so_far), max(self.most, so_far)
        self.over = self.control == model.n_controls
        return self._see(), before - self.loss, False, self.over, {"loss": self.loss}

    # --- parts -------------------------------------------------------------------------------------------------------

    def _draw(self) -> Goals:
        return {name: goal.draw(self.np_random) for name, goal in self.agent.built.scene.goals.items()}

    def _see(self) -> Array:
        rollout, control = self.rollout, self.control
        self.observation, self.remembered = self.policy.observe(
            control, rollout.sight(control), rollout.memory[control], lambda: rollout.unpack(self.states[0], control)
        )
        return self.observation

    def _blow_up_reward(self) -> float:
        """Return a reward that makes the episode's sum less than all sums so far, so that blowing up never pays."""
        below = self.least - (self.most - self.least) - abs(self.first)
        return below - (self.first - self.loss)

    def _empty_track(self) -> Track:
        """Return the episode in the form of the objective, which each step fills."""
        zeros = self.rollout.read_records().zeros_like()
        return self.agent.track(zeros, self.rollout, self.goals, activation=np.zeros_like(self.rollout.activation))

    def _loss_if_it_ended(self) -> float:
        """Return the loss if the last record was repeated to the end of the run, with zero activations."""
        control, at = self.control, self.agent.places[OBJECTIVE]
        now = Records.from_rows(self.rollout.records[control : control + 1], self.agent.model.layout.table)
        for name in ("x", "v", "C", "F"):
            getattr(self.track, name)[control:] = getattr(now, name)[:, at]
        for name, rows in self.rollout.held_at(control).items():
            self.track.held[name][control:] = rows
        for name, rows in self.rollout.rigid_at(control).items():
            self.track.rigid[name][control:] = rows
        self.track.activation[:control] = self.rollout.activation[:control]
        return float(self.agent.objective.loss(self.track))


def environment(
    scene: str | Path | dict[str, Any], overrides: Sequence[str] = (), *, threads: int | None = None,
    allow_plugins: bool = False,
) -> SceneEnvironment:  # fmt: skip
    """Return a scene as a Gymnasium environment.

    Args:
        scene: a file, the scene's data, or a run directory: its scene with the design that the run has learned.
        overrides: list of `key=value`, as on the command line.
        threads: largest number of threads; all cores if not given.
        allow_plugins: whether the Python files of the scene's plug-ins may be run.

    Raises:
        MissingExtra: gymnasium is not installed. SceneError: the scene does not fit. UsageError: the run has found no
            design yet, or an override would replace it.
    """
    n_threads = cores(checked_threads("environment", scene, overrides, threads))
    is_run = not isinstance(scene, dict) and os.path.isdir(scene)  # noqa: PTH112  Path's own raises at a long text
    with plugins_allowed(allow_plugins):
        if is_run:
            return _of_run(Path(scene), overrides, n_threads)  # type: ignore[arg-type]
        env = SceneEnvironment(load_scene(scene, overrides), n_threads)
    if unknowns := env.agent.built.scene.unknowns:
        warnings.warn(
            f"unknowns: {listed(unknowns)} stay at their start: an environment learns no design; give a run directory "
            "to use the design that the run has found", stacklevel=2,
        )  # fmt: skip
    return env


def _of_run(run: Path, overrides: Sequence[str], threads: int) -> SceneEnvironment:
    """Return the environment of a run's scene, with the run's design."""
    scene, file = scene_in(run), run / FILE
    design = design_in(file, scene, overrides) if file.is_file() else {}
    scene = scene_in(run, overrides)
    if scene.unknowns and not design:
        raise UsageError(f"{run}: has found no design yet (no {FILE} has one); -o unknowns={{}} takes its scene's own")
    return SceneEnvironment(scene, threads, design, file)
