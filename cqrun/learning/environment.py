"""A scene as a Gymnasium environment: for learners without gradients, such as PPO (extra `rl`).

    env = cqrun.environment("scenes/control/finger.yaml")
    observation, info = env.reset(seed=0)
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

A step is a control step. Observations are those of the scene's observers, or time where it has none; actions those of a
bounded controller: numbers in [-1, 1], mapped to the actuators' limits. The reward is by how much the loss falls, were
the run to end here and stay as it is; so an episode's rewards sum to what its end improves on its beginning, whatever
the objective. It knows no constraints: a scene that has any is refused. Unknowns stay at their start, or in the
environment of a run, `cqrun.environment("results/arm/d47b0a4e3f21")`, are what the run has found.

An episode that blows up ends there, and its rewards sum to less than those of any episode have at any step so far: by
as much as those sums lie apart, and by the size of the loss that it began with. A reward of nothing would pay wherever
the loss grows with time.
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
from cqrun.objectives.term import Track
from cqrun.observers.clock import Clock
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
    "an environment honours no constraints: make them terms of the objective, each with a weight, or remove them "
    "(-o constraints={})"
)


class SceneEnvironment(gymnasium.Env[Array, Array]):
    """One scene, one body of particles, one episode at a time.

    Args:
        scene: with actuators and an objective; its controller, if it has one, does not act.
        threads: how many to use at most. Results do not depend on it.
        design: values of its unknowns by path, and of what follows them; those that are left out are at their start.
        source: the file that they are from.

    Raises:
        SceneError: it lacks one of them, or has constraints. UsageError: the design is of other bodies.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  the name and form that gymnasium wants

    def __init__(
        self, scene: Scene, threads: int = 1, design: Values | None = None, source: Path = Path()
    ) -> None:  # fmt: skip
        told = {key: f"an environment needs it: {why}" for key, why in NEEDED.items() if not getattr(scene, key)}
        told |= {"constraints": CONSTRAINED} if scene.constraints else {}
        if told:
            raise SceneError([Problem(scene.where(key), key, message) for key, message in told.items()])
        if not scene.observers:
            scene = scene.model_copy(update={"observers": {"clock": Chosen("clock", Clock())}})
        # one that answers in [-1, 1], as whoever calls `step` does in its place
        self.agent, self.threads = Agent(build(scene.with_plugin("controller", LinearTanh()))), threads
        self.design = {} if design is None else dict(design)
        require_fitting(source, self.design, self.agent.params)
        self.least = self.most = 0.0  # sums of rewards, at any step of any episode
        n, a = self.agent.observation.size, len(self.agent.limits.low)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (a,), np.float64)

    # --- gymnasium's interface ------------------------------------------------------------------------------------

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode with goals drawn from their ranges; return what is seen, and the goals."""
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
        """Run one control step; return (what is seen, reward, whether it blew up, whether time is over, facts).

        Raises:
            UsageError: there is no episode to go on with, or the action is not of the space's shape, or not finite.
        """
        if not hasattr(self, "rollout") or self.over:
            raise UsageError("step: the episode is over, or none was begun; call reset() first")
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
            return self.seen, self._reward_of_a_blow_up(), True, False, {"failed": str(error), "loss": self.loss}
        self.control += 1
        before, self.loss = self.loss, self._loss_if_it_ended()
        so_far = self.first - self.loss
        self.least, self.most = min(self.least, so_far), max(self.most, so_far)
        self.over = self.control == model.n_controls
        return self._see(), before - self.loss, False, self.over, {"loss": self.loss}

    # --- what it is made of ------------------------------------------------------------------------------------------

    def _draw(self) -> Goals:
        return {name: goal.draw(self.np_random) for name, goal in self.agent.built.scene.goals.items()}

    def _see(self) -> Array:
        rollout, control = self.rollout, self.control
        self.seen, self.remembered = self.policy.observe(
            control, rollout.records[control], rollout.memory[control], lambda: rollout.unpack(self.states[0], control)
        )
        return self.seen

    def _reward_of_a_blow_up(self) -> float:
        """Return what brings an episode's sum of rewards below all that there were, so that blowing up cannot pay."""
        below = self.least - (self.most - self.least) - abs(self.first)
        return below - (self.first - self.loss)

    def _empty_track(self) -> Track:
        """Return the episode as the objective sees it, to be filled step by step."""
        rows = Records.from_rows(self.rollout.records, self.agent.model.layout.table)
        kept = rows.zeros_like()
        return self.agent.track(kept, self.rollout, self.goals, activation=np.zeros_like(self.rollout.activation))

    def _loss_if_it_ended(self) -> float:
        """Return the loss of the run so far, its last record standing for all that is to come, without effort."""
        control, at = self.control, self.agent.places[OBJECTIVE]
        now = Records.from_rows(self.rollout.records[control : control + 1], self.agent.model.layout.table)
        for name in ("x", "v", "C", "F"):
            getattr(self.track, name)[control:] = getattr(now, name)[:, at]
        self.track.activation[:control] = self.rollout.activation[:control]
        return float(self.agent.objective.loss(self.track))


def environment(
    scene: str | Path | dict[str, Any], overrides: Sequence[str] = (), *, threads: int | None = None,
    allow_plugins: bool = False,
) -> SceneEnvironment:  # fmt: skip
    """Return a scene as a Gymnasium environment.

    Args:
        scene: a file, the scene's data, or a run's directory: its scene, with the design that it has learned.
        overrides: `key=value`, as on the command line.
        threads: how many to use at most; all cores if not given.
        allow_plugins: run the Python files that the scene names.

    Raises:
        MissingExtra: gymnasium is not installed. SceneError: the scene cannot be one. UsageError: the run has found no
            design yet, or an override is of one that it holds.
    """
    n_threads = cores(checked_threads("environment", scene, overrides, threads))
    is_run = not isinstance(scene, dict) and os.path.isdir(scene)  # noqa: PTH112  Path's own raises at a long text
    with plugins_allowed(allow_plugins):
        if is_run:
            return _of_run(Path(scene), overrides, n_threads)  # type: ignore[arg-type]
        made = SceneEnvironment(load_scene(scene, overrides), n_threads)
    if unknowns := made.agent.built.scene.unknowns:
        warnings.warn(
            f"unknowns: {listed(unknowns)} stay at their start: an environment learns no design; give the directory of "
            "a run to act on what it has found", stacklevel=2,
        )  # fmt: skip
    return made


def _of_run(run: Path, overrides: Sequence[str], threads: int) -> SceneEnvironment:
    """Return the environment of a run's scene, with the design that it has learned."""
    scene, file = scene_in(run), run / FILE
    design = design_in(file, scene, overrides) if file.is_file() else {}
    scene = scene_in(run, overrides)
    if scene.unknowns and not design:
        raise UsageError(f"{run}: has found no design yet (no {FILE} has one); -o unknowns={{}} takes its scene's own")
    return SceneEnvironment(scene, threads, design, file)
