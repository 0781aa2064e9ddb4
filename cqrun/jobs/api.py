"""cqrun from Python: a scene as a function, NumPy in and out.

    problem = cqrun.load("scenes/sysid/beam_twin.yaml", ["time.duration=0.3"])
    loss, gradient, aux = problem.value_and_grad({"loads.air.damping.rate": 2.0})
    motion = problem.simulate()

A scene with a controller and an objective is a function of the controller's parameters too, by the names of its blocks:

    problem = cqrun.load("scenes/control/finger.yaml")
    weights = problem.params["controller.weights"]       # (actuators, observations)
    loss, gradient, aux = problem.value_and_grad({"controller.weights": 0.5 * weights})
    motion = problem.simulate(goals={"target": [0.55, 0.6]})

A run goes on from here: its scene, and what it found.

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
from cqrun.scene.paths import canonical, leaf, leaves, with_values
from cqrun.scene.plugin_files import plugins_allowed
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import body_of, groups_of
from cqrun.state import State
from cqrun.store.result import read_result, values_in
from cqrun.store.run import read_record

Values = Mapping[str, Any]
"""Key path -> number, or an array with one number a group or a particle of the body; `controller.<block>` -> array.

What follows an unknown (`also`) follows its value here too, unless it is given itself; a number then stands for all.
"""


@dataclass(frozen=True)
class Motion:
    """What a simulation did.

    Attributes:
        time: of the control steps 0 .. T (T + 1,) [s].
        x: positions (T + 1, N, D) [m].
        v: velocities (T + 1, N, D) [m/s].
        bodies: each body's slice of the N particles.
        activation: of the actuators' A parts in every control step (T, A), as the controller or the signals drove them.
    """

    time: Array
    x: Array
    v: Array
    bodies: dict[str, slice]
    activation: Array


class Experiment:
    """A scene as a function of its numbers.

    Args:
        scene: validated.
        threads: how many to use at most; all cores if not given. Results do not depend on it.
        run: directory of the run that the scene is of, if it is one's.

    Attributes:
        built: the scene's particles and model.
        params: its unknowns at their starts, by key path; arrays where there is one number a group or particle. Before
            them the controller's parameters, if it has one, as `controller.<block>`: arrays of the block's shape, such
            as (A, observations) for the weights of `linear_tanh`, with A the parts of all actuators.

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
        """What the run found, as `params` to go on with: its unknowns, and its controller's parameters.

        Of a run of control or co-design that still goes on, those of its best iteration so far.

        Raises:
            UsageError: the scene is no run's, or the run has found nothing.
        """
        if self._run is None:
            raise UsageError("found: this scene is no run's; load the run's directory, results/<scene>/<12 hex digits>")
        values = _found_in(self._run)
        followers = {f.path for b in self._params.blocks for f in b.followers}
        own = {p: _plain(np.array(v, float)) for p, v in values.items() if p not in followers}
        if not own:
            record = read_record(self._run)
            raise UsageError(f"{self._run}: found nothing (a run of {record.get('job')}, {record['status']})")
        return own

    def value_and_grad(self, params: Values | None = None) -> tuple[float, dict[str, Any], dict[str, Any]]:
        """Return the loss of the scene's data, or the mean loss of its episodes, its gradient, and what else is known.

        Episodes are those of the first iteration of `cqrun control`: goals that are drawn are the same at every call.

        Args:
            params: values by key path: of any numbers that gradients reach, not of the unknowns alone, and of the
                controller's parameters. Those that are left out keep their start; bounds are not enforced.

        Returns:
            The loss; its derivative by every unknown, every parameter of the controller and every number in `params`,
            of the shape of its value; and {"losses": part of the loss by recording or sequence, or the loss of each
            episode, "gradient": {"recompute_factor", "peak_bytes"}}, with "terms" and "constraints" (the mean of
            each over the episodes, by name) and "goals" (of each episode) where there are episodes.

        Raises:
            UsageError: a path or a shape that cannot be, or a scene with neither data nor an objective.
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
        problem, values = self._problem, self._stable(params)
        problem.require_reached(values)
        losses, gradient = problem.losses_and_gradient(values)
        effort = {"recompute_factor": problem.effort.recompute, "peak_bytes": problem.effort.peak}
        aux = {"losses": losses, "gradient": effort}
        return float(sum(losses.values())), self._with_followers(gradient, params), aux

    def simulate(self, params: Values | None = None, goals: Mapping[str, Any] | None = None) -> Motion:
        """Run the scene forward, under its controller if it has one.

        Args:
            params: values by key path, as for `value_and_grad`.
            goals: goal -> its entries [m]; a goal that is left out is at its position, the middle of its range.

        Raises:
            UsageError: a path, a goal or a shape that cannot be. RolloutError: the scene blows up.
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
        known = {} if self._agent is None else dict(self._agent.goals_in_the_middle)
        for name, entries in goals.items():
            if name not in known:
                raise UsageError(f"goals: there is no '{name}'{suggest(name, known)}; there are: {listed(known)}")
            goal = _numbers(f"goals: '{name}'", entries)
            if goal.shape != known[name].shape or not np.isfinite(goal).all():
                raise UsageError(f"goals: '{name}' must be {len(known[name])} finite numbers, is {entries!r}")
            known[name] = goal
        if self._agent is not None:
            return self._agent.rollout(values, known, self.threads)
        return Rollout(self.built.model, self.built.assembly.inputs(values), threads=self.threads)

    @cached_property
    def _problem(self) -> FitProblem:
        return FitProblem(given_cases(self.built) or make_cases(self.built), self._params, threads=self.threads)

    def _values(self, params: Values | None) -> dict[str, Array]:
        if not isinstance(params, Mapping | None):
            raise UsageError(f"params must be a mapping from key paths to values, is {shown(params)}")
        given: dict[str, Array] = {}
        for path, value in (params or {}).items():
            known = self._known(path)
            given[known] = self._shaped(known, _numbers(path, value))
        self._require_legal(given)
        values = {b.path: b.initial.copy() for b in self._params.blocks} | given
        for block in self._params.blocks:
            for follower in block.followers:
                if follower.path not in given:
                    values[block.path] = _followed(block, values[block.path])
                    values[follower.path] = follower.of(values[block.path])
        return values

    def _require_legal(self, given: Mapping[str, Array]) -> None:
        """Refuse values that the scene would refuse, of arrays the least and the greatest."""
        own = {path: value for path, value in given.items() if not path.startswith(CONTROLLER)}
        for end in (np.min, np.max) if any(value.ndim for value in own.values()) else (np.min,):
            try:
                with_values(self.scene, {path: float(end(value)) for path, value in own.items()})
            except SceneError as error:
                raise UsageError("; ".join(f"{p.path}: {p.message}" for p in error.problems)) from None

    def _stable(self, params: Values | None) -> dict[str, Array]:
        """Return all values; refuse those for which the substep is too large that `auto` has chosen for the scene.

        A number of substeps that the scene gives is its user's own: values that it does not suit blow up.
        """
        values = self._values(params)
        if not (params and self._auto):
            return values
        try:
            least, needed = stable(self.built, {p: v for p, v in values.items() if not p.startswith(CONTROLLER)})
        except SceneError as error:
            raise UsageError("; ".join(f"{p.path}: {p.message}" for p in error.problems)) from None
        if self.built.model.dt > least.dt:
            raise UsageError(
                f"{least.part}: with these values the largest stable substep is {least.dt:.3g} s, and `auto` has "
                f"chosen {self.built.model.dt:.3g} s for the scene as it is: load it with time.substeps={needed}, or "
                "with what changes as an unknown whose bounds hold these values"
            )
        return values

    def _with_followers(self, gradient: dict[str, Array], params: Values | None) -> dict[str, Any]:
        """Return a gradient in which an unknown's has that of what follows it, unless that was given on its own."""
        given = {self._known(path) for path in params or {}}
        for block in self._params.blocks:
            for follower in block.followers:
                if follower.path not in given:
                    gradient[block.path] = gradient[block.path] + follower.of_vjp(gradient.pop(follower.path))
        return {path: _plain(bar) for path, bar in gradient.items()}

    def _known(self, path: str) -> str:
        """Return the long spelling of a path that gradients reach; a block of the controller has but one."""
        if not isinstance(path, str):
            raise UsageError(f"params: a key path is text, such as 'world.gravity.1', not {shown(path)}")
        own = [b.path for b in self._params.blocks]
        if path.startswith(CONTROLLER):
            if path in own:
                return path
            blocks = [p for p in own if p.startswith(CONTROLLER)]
            raise UsageError(f"{path}: no block of the controller{suggest(path, blocks)}; there are: {listed(blocks)}")
        reached = list(leaves(self.scene, differentiable=True))
        try:
            if leaf(self.scene, path).differentiable:
                return canonical(self.scene, path)
        except SceneError as error:
            raise UsageError(f"{path}: {error.problems[0].message}") from None
        raise UsageError(f"{path}: no gradient reaches it{suggest(path, reached)}; there are: {listed(reached)}")

    def _shaped(self, path: str, value: Array) -> Array:
        """Return a value of a legal shape: a block's, or () or, of a material or weight, one a group or a particle."""
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


def _of_episodes(problem: EpisodeProblem, values: dict[str, Array]) -> tuple[float, dict[str, Array], dict[str, Any]]:
    """Return the mean loss of the first iteration's episodes, its gradient, and what else is known."""
    goals = problem.goals(None)
    found, (gradient,) = problem.attempts_with_gradients(values, goals)
    aux = {
        "losses": {f"episode {k}": float(attempt.loss) for k, attempt in enumerate(found)},
        "terms": {name: float(np.mean([a.terms[name] for a in found])) for name in problem.summands},
        "constraints": {name: float(np.mean([a.held[name] for a in found])) for name in problem.constraint_names},
        "goals": [{name: goal.copy() for name, goal in drawn.items()} for drawn in goals],
        "gradient": {"recompute_factor": problem.effort.recompute, "peak_bytes": problem.effort.peak},
    }
    return float(np.mean([a.loss for a in found])), gradient, aux


def _followed(block: Block, value: Array) -> Array:
    """Return the value of an unknown that others follow, entry by entry: one number stands for all."""
    if value.shape not in ((), block.initial.shape):
        some = f" or of shape {block.initial.shape}" if block.initial.ndim else ""
        others = listed(follower.path for follower in block.followers)
        raise UsageError(
            f"{block.path}: a value of shape {value.shape}; it must be a number{some}, for {others} to follow"
        )
    return np.array(np.broadcast_to(value, block.initial.shape))


def _found_in(run: Path) -> dict[str, Any]:
    """Return the numbers that a run has found by path, from its controller's file or its result."""
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
    """Return a number for an array of no dimension, else a copy of the array."""
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
        scene: a file's path, YAML text (with a line break), plain data, or a run's directory: its scene, with all
            values as they were at its start; `found` has those at its end.
        overrides: `key.path=value` each, as `-o` of the command line.
        threads: how many to use at most; all cores if not given.
        allow_plugins: whether the Python files that the scene names as its plug-ins may be run.

    Raises:
        SceneError: every problem of the scene, each with its place. UsageError: an argument that cannot be, or a run
            that reads a file which has changed since.
    """
    n_threads = checked_threads("load", scene, overrides, threads)
    is_run = not isinstance(scene, dict) and os.path.isdir(scene)  # noqa: PTH112  Path's own raises at a long text
    run = Path(scene) if is_run else None  # type: ignore[arg-type]
    with plugins_allowed(allow_plugins):
        given = load_scene(scene, overrides) if run is None else scene_in(run, overrides, with_data=True)
        return Experiment(given, n_threads, run)
