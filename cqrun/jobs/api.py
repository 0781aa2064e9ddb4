"""Use cqrun from Python: a scene is a function of its numbers, with NumPy arrays in and out.

    problem = cqrun.load("scenes/sysid/beam_twin.yaml", ["time.duration=0.3"])
    loss, gradient, aux = problem.value_and_grad({"loads.air.damping.rate": 2.0})
    motion = problem.simulate()

If a scene has a controller and an objective, it is also a function of the controller's parameters, named by block:

    problem = cqrun.load("scenes/control/finger.yaml")
    weights = problem.params["controller.weights"]       # (actuators, observations)
    loss, gradient, aux = problem.value_and_grad({"controller.weights": 0.5 * weights})
    motion = problem.simulate(goals={"target": [0.55, 0.6]})

A run directory gives its scene and the values that it found:

    problem = cqrun.load("results/finger/d47b0a4e3f21")
    motion = problem.simulate(problem.found)
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built, build, stable
from cqrun.controllers.saved import read_controller
from cqrun.design.params import Block
from cqrun.engine.frames import make_rollout
from cqrun.engine.rollout import Rollout
from cqrun.errors import SceneError, UsageError
from cqrun.explain import listed, shown, suggest
from cqrun.fitting.cases import given_cases, make_cases
from cqrun.fitting.problem import FitProblem
from cqrun.learning.agent import CONTROLLER, FILE, Agent
from cqrun.learning.episodes import EpisodeProblem, has_episodes
from cqrun.optimizers.base import one_blas_thread
from cqrun.plugin.contract import Array
from cqrun.running.runs import scene_in
from cqrun.running.threads import checked_threads, cores
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene
from cqrun.scene.paths import canonical, leaf, leaves, require_possible
from cqrun.scene.plugin_files import plugins_allowed
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import body_of, groups_of
from cqrun.state import State
from cqrun.store.result import read_result, values_in
from cqrun.store.run import read_record

Values = Mapping[str, Any]
"""Key path -> number, or an array with one number per group or particle of the body; `controller.<block>` -> array.

Values that follow an unknown (`also`) follow it here too, unless they are given; a single number applies to all.
"""


@dataclass(frozen=True)
class Motion:
    """The motion of a simulation.

    Attributes:
        time: times of the control steps 0 .. T (T + 1,) [s].
        x: positions (T + 1, N, D) [m].
        v: velocities (T + 1, N, D) [m/s].
        bodies: each body's slice of the N particles.
        activation: activations of the actuators' A parts in every control step (T, A).
    """

    time: Array
    x: Array
    v: Array
    bodies: dict[str, slice]
    activation: Array


class Experiment:
    """A scene as a function of its numbers.

    Args:
        scene: a validated scene.
        threads: largest number of threads; all cores if not given. Results do not depend on it.
        run: the run directory of the scene, if it has one.

    Attributes:
        built: the scene's particles and model.
        params: start values by key path: first the controller's parameters, if there is a controller, as
            `controller.<block>` with the shape of the block, such as (A, observations) for the weights of `linear_tanh`
            with A actuator parts; then the unknowns, as arrays if they have one number per group or particle.

    Raises:
        SceneError: the scene cannot be built, or an observer or a term of the objective does not fit it.
        UsageError: the run has trained another controller than the scene's.
    """

    def __init__(self, scene: Scene, threads: int | None = None, run: Path | None = None) -> None:
        self._run, trained = run, run / FILE if run is not None and (run / FILE).is_file() else None
        self._auto = scene.time.substeps == "auto"
        self.built: Built = build(scene)
        self.threads = cores(threads)
        self._agent = None if self.scene.controller is None else Agent(self.built, trained)
        self._episodes: EpisodeProblem | None = None
        if self._agent is not None and has_episodes(self.scene):
            self._episodes = EpisodeProblem(self._agent, threads=self.threads)
        self._params = make_params(self.built) if self._agent is None else self._agent.params
        self.params: dict[str, Any] = {b.path: _plain(b.initial) for b in self._params.blocks}

    @property
    def scene(self) -> Scene:
        """The resolved scene."""
        return self.built.scene

    @property
    def found(self) -> dict[str, Any]:
        """The values that the run found, in the form of `params`: unknowns and the controller's parameters.

        If a run of control or co-design has not finished, they are those of its best iteration so far.

        Raises:
            UsageError: the scene does not belong to a run, or the run has found nothing.
        """
        if self._run is None:
            raise UsageError("found: this scene has no run; load a run directory, results/<scene>/<12 hex digits>")
        values = _found_in(self._run)
        followers = {f.path for b in self._params.blocks for f in b.followers}
        params = {p: _plain(np.array(v, float)) for p, v in values.items() if p not in followers}
        if not params:
            record = read_record(self._run)
            raise UsageError(f"{self._run}: found nothing (a run of {record.get('job')}, {record['status']})")
        return params

    def value_and_grad(self, params: Values | None = None) -> tuple[float, dict[str, Any], dict[str, Any]]:
        """Return the loss of the scene's data, or the mean loss of its episodes, its gradient, and further results.

        The episodes are those of the first iteration of `cqrun control`; their goals are the same at every call.

        Args:
            params: values by key path, of the controller's parameters and of any numbers that gradients reach, also
                those that are not unknowns. Missing ones keep their start value; bounds are not enforced.

        Returns:
            The loss; its derivatives by every unknown, every parameter of the controller and every number in `params`,
            in the shape of the value; and {"losses": part of the loss by recording or sequence, or the loss of each
            episode, "gradient": {"recompute_factor", "peak_bytes"}}. If there are episodes, also "terms" and
            "constraints" (means over the episodes, by name) and "goals" (of each episode).

        Raises:
            UsageError: a path or a shape is wrong, or the scene has neither data nor an objective.
            RolloutError: the scene blows up.
        """
        with one_blas_thread():
            return self._value_and_grad(params)

    def _value_and_grad(self, params: Values | None) -> tuple[float, dict[str, Any], dict[str, Any]]:
        if self._episodes is not None:
            loss, gradient, aux = _of_episodes(self._episodes, self._stable(params))
            return loss, self._with_followers(gradient, params), aux
        if self.scene.data is None and not self.scene.objective:
            raise UsageError(
                "this scene has neither `data` nor an `objective`, so there is no loss: add one, or use simulate()"
            )
        if self.scene.predicts_only:
            raise UsageError("every recording is held out, so there is no loss: fit one of them, or use simulate()")
        problem, values = self._problem, self._stable(params)
        for case in problem.cases if params and self._auto else ():
            if not case.points:
                _require_stable(case.built, case.own_values(values))
        problem.require_reached(values)
        losses, gradient = problem.losses_and_gradient(values)
        effort = {"recompute_factor": problem.effort.recompute, "peak_bytes": problem.effort.peak}
        aux = {"losses": losses, "gradient": effort}
        return float(sum(losses.values())), self._with_followers(gradient, params), aux

    def simulate(self, params: Values | None = None, goals: Mapping[str, Any] | None = None) -> Motion:
        """Run the scene forward, with its controller if it has one.

        Args:
            params: values by key path, as for `value_and_grad`.
            goals: goal -> its entries [m]; a missing goal is in the middle of its range.

        Raises:
            UsageError: a path, a goal or a shape is wrong. RolloutError: the scene blows up.
        """
        n_controls, step = self.built.model.n_controls, self.scene.time.control_step
        n, dim = self.built.particles.x.shape
        x, v = np.zeros((n_controls + 1, n, dim)), np.zeros((n_controls + 1, n, dim))

        def keep(control: int, state: State) -> None:
            x[control], v[control] = state.x, state.v

        rollout = self._rollout(self._stable(params), {} if goals is None else goals)
        with one_blas_thread():
            rollout.run(keep)
        particles = self.built.particles
        bodies = {name: particles.of(name) for name in particles.names}
        return Motion(np.arange(n_controls + 1) * step, x, v, bodies, rollout.activation.copy())

    def _rollout(self, values: dict[str, Array], goals: Mapping[str, Any]) -> Rollout:
        if not isinstance(goals, Mapping):
            raise UsageError(f"goals must be a mapping from goals to their entries, is {shown(goals)}")
        chosen = {} if self._agent is None else dict(self._agent.goals_in_the_middle)
        for name, entries in goals.items():
            if name not in chosen:
                raise UsageError(f"goals: there is no '{name}'{suggest(name, chosen)}; there are: {listed(chosen)}")
            goal = _numbers(f"goals: '{name}'", entries)
            if goal.shape != chosen[name].shape or not np.isfinite(goal).all():
                raise UsageError(f"goals: '{name}' must be {len(chosen[name])} finite numbers, is {entries!r}")
            chosen[name] = goal
        if self._agent is not None:
            return self._agent.rollout(values, chosen, self.threads)
        return make_rollout(self.built.model, self.built.assembly.inputs(values), threads=self.threads)

    @cached_property
    def _problem(self) -> FitProblem:
        return FitProblem(given_cases(self.built) or make_cases(self.built), self._params, threads=self.threads)

    def _values(self, params: Values | None) -> dict[str, Array]:
        if not isinstance(params, Mapping | None):
            raise UsageError(f"params must be a mapping from key paths to values, is {shown(params)}")
        given: dict[str, Array] = {}
        for path, value in (params or {}).items():
            full = self._full_path(path)
            given[full] = self._shaped(full, _numbers(path, value))
        self._require_legal(given)
        values = {b.path: b.initial.copy() for b in self._params.blocks} | given
        for block in self._params.blocks:
            for follower in block.followers:
                if follower.path not in given:
                    values[block.path] = _followed(block, values[block.path])
                    values[follower.path] = follower.of(values[block.path])
        return values

    def _require_legal(self, given: Mapping[str, Array]) -> None:
        """Raise UsageError for values that the scene refuses; check the smallest and largest number of arrays."""
        of_scene = {path: value for path, value in given.items() if not path.startswith(CONTROLLER)}
        for end in (np.min, np.max) if any(value.ndim for value in of_scene.values()) else (np.min,):
            try:
                require_possible(self.scene, {path: float(end(value)) for path, value in of_scene.items()})
            except SceneError as error:
                raise UsageError("; ".join(f"{p.path}: {p.message}" for p in error.problems)) from None

    def _stable(self, params: Values | None) -> dict[str, Array]:
        """Return all values; raise UsageError if they are not stable with the substep that `auto` has chosen.

        A number of substeps that the scene gives is not checked: unsuitable values blow up.
        """
        values = self._values(params)
        if params and self._auto:
            _require_stable(self.built, {p: v for p, v in values.items() if not p.startswith(CONTROLLER)})
        return values

    def _with_followers(self, gradient: dict[str, Array], params: Values | None) -> dict[str, Any]:
        """Return the gradient with the parts of followers added to their unknowns, unless a follower was given."""
        given = {self._full_path(path) for path in params or {}}
        for block in self._params.blocks:
            for follower in block.followers:
                if follower.path not in given:
                    gradient[block.path] = gradient[block.path] + follower.of_vjp(gradient.pop(follower.path))
        return {path: _plain(bar) for path, bar in gradient.items()}

    def _full_path(self, path: str) -> str:
        """Return the long form of a path that gradients reach."""
        if not isinstance(path, str):
            raise UsageError(f"params: a key path is text, such as 'world.gravity.1', not {shown(path)}")
        if path.startswith(CONTROLLER):
            blocks = [b.path for b in self._params.blocks if b.path.startswith(CONTROLLER)]
            if path in blocks:
                return path
            raise UsageError(f"{path}: no block of the controller{suggest(path, blocks)}; there are: {listed(blocks)}")
        reached = list(leaves(self.scene, differentiable=True))
        try:
            if leaf(self.scene, path).differentiable:
                return canonical(self.scene, path)
        except SceneError as error:
            raise UsageError(f"{path}: {error.problems[0].message}") from None
        raise UsageError(f"{path}: no gradient reaches it{suggest(path, reached)}; there are: {listed(reached)}")

    def _shaped(self, path: str, value: Array) -> Array:
        """Check a value: its shape is a block's, (), or for materials and weights one number per group or particle."""
        keys = path.split(".")
        legal: list[tuple[int, ...]] = [()]
        if path.startswith(CONTROLLER):
            legal = [b.initial.shape for b in self._params.blocks if b.path == path]
        elif (keys[0] == "bodies" and keys[2] == "material") or (keys[0] == "actuators" and keys[-1] == "weight"):
            part, groups = self.built.particles.of(body_of(self.scene, path)), len(groups_of(self.scene, path))
            legal += [(part.stop - part.start,), *[(groups,)] * (groups > 0)]
        if value.shape not in legal:
            raise UsageError(f"{path}: a value of shape {value.shape}; it must be one of {listed(map(str, legal))}")
        if not np.isfinite(value).all():
            raise UsageError(f"{path}: must be finite, is {value}")
        return value


def _require_stable(built: Built, values: dict[str, Array]) -> None:
    """Raise UsageError if values by path are not stable with the substep of a scene."""
    try:
        least, needed = stable(built, values)
    except SceneError as error:
        raise UsageError("; ".join(f"{p.path}: {p.message}" for p in error.problems)) from None
    if built.model.dt > least.dt:
        raise UsageError(
            f"{least.part}: with these values the largest stable substep is {least.dt:.3g} s, but `auto` has "
            f"chosen {built.model.dt:.3g} s for the scene: load it with time.substeps={needed}, or make what "
            "changes an unknown with bounds that contain these values"
        )


def _of_episodes(problem: EpisodeProblem, values: dict[str, Array]) -> tuple[float, dict[str, Array], dict[str, Any]]:
    """Return the mean loss of the first iteration's episodes, its gradient, and further results."""
    goals = problem.goals(None)
    attempts, (gradient,) = problem.attempts_with_gradients(values, goals)
    aux = {
        "losses": {f"episode {k}": float(attempt.loss) for k, attempt in enumerate(attempts)},
        "terms": {name: float(np.mean([a.terms[name] for a in attempts])) for name in problem.summands},
        "constraints": {n: float(np.mean([a.constraints[n] for a in attempts])) for n in problem.constraint_names},
        "goals": [{name: goal.copy() for name, goal in drawn.items()} for drawn in goals],
        "gradient": {"recompute_factor": problem.effort.recompute, "peak_bytes": problem.effort.peak},
    }
    return float(np.mean([a.loss for a in attempts])), gradient, aux


def _followed(block: Block, value: Array) -> Array:
    """Return the value of an unknown with followers in its full shape; a single number applies to all entries."""
    if value.shape not in ((), block.initial.shape):
        some = f" or of shape {block.initial.shape}" if block.initial.ndim else ""
        others = listed(follower.path for follower in block.followers)
        raise UsageError(
            f"{block.path}: a value of shape {value.shape}; it must be a number{some}, for {others} to follow"
        )
    return np.array(np.broadcast_to(value, block.initial.shape))


def _found_in(run: Path) -> dict[str, Any]:
    """Return the values that a run has found by path, from its controller's file or its result."""
    if (run / FILE).is_file():
        parameters, meta = read_controller(run / FILE)
        return {CONTROLLER + name: value for name, value in parameters.items()} | meta.get("unknowns", {})
    return dict(values_in(read_result(run)))


def _numbers(path: str, value: Any) -> Array:
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(f"{path}: must be a number or an array of numbers, is {shown(value)}") from None


def _plain(value: Array) -> Any:
    """Return a 0-dimensional array as a number, another as a copy."""
    return float(value) if np.ndim(value) == 0 else np.array(value)


def load(
    scene: Path | str | dict[str, Any],
    overrides: Sequence[str] = (),
    *,
    threads: int | None = None,
    allow_plugins: bool = False,
) -> Experiment:
    """Return a scene as a function.

    Args:
        scene: path of a file, YAML text (with a line break), plain data, or a run directory. The scene of a run has the
            values of its start; `found` has those of its end.
        overrides: list of `key.path=value`, as for `-o` of the command line.
        threads: largest number of threads; all cores if not given.
        allow_plugins: whether the Python files of the scene's plug-ins may be run.

    Raises:
        SceneError: all problems of the scene with their places. UsageError: an argument is wrong, or a file that the
            run uses has changed since.
    """
    n_threads = checked_threads("load", scene, overrides, threads)
    is_run = not isinstance(scene, dict) and os.path.isdir(scene)  # noqa: PTH112  Path's own raises at a long text
    run = Path(scene) if is_run else None  # type: ignore[arg-type]
    with plugins_allowed(allow_plugins):
        given = load_scene(scene, overrides) if run is None else scene_in(run, overrides, with_data=True)
        return Experiment(given, n_threads, run)
