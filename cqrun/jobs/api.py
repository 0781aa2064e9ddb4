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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.build.model import Built, build
from cqrun.controllers.saved import read_controller
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Model
from cqrun.engine.rollout import Rollout
from cqrun.errors import UsageError
from cqrun.explain import listed, shown, suggest
from cqrun.fitting.cases import given_cases, make_cases
from cqrun.fitting.problem import FitProblem
from cqrun.jobs.given_values import GivenValues, Values, numbers_of, plain, require_stable
from cqrun.learning.agent import CONTROLLER, FILE, Agent
from cqrun.learning.episodes import EpisodeProblem, has_episodes
from cqrun.optimizers.base import one_blas_thread
from cqrun.plugin.contract import Array
from cqrun.running.measuring import Measuring
from cqrun.running.runs import scene_in
from cqrun.running.threads import checked_threads, cores
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaf
from cqrun.scene.plugin_files import plugins_allowed
from cqrun.scene.schema import Scene
from cqrun.state import State
from cqrun.store.result import read_result, values_in
from cqrun.store.run import read_record

if TYPE_CHECKING:
    from cqrun.jobs.own_loss import OwnLoss


@dataclass(frozen=True)
class Motion:
    """The motion of a simulation.

    Attributes:
        time: times of the control steps 0 .. T (T + 1,) [s].
        x: positions (T + 1, N, D) [m].
        v: velocities (T + 1, N, D) [m/s].
        bodies: each body's slice of the N particles.
        activation: activations of the actuators' A parts in every control step (T, A).
        measured: quantities that the scene measures, by name: (T + 1, n), NaN where one has no value.
    """

    time: Array
    x: Array
    v: Array
    bodies: dict[str, slice]
    activation: Array
    measured: dict[str, Array] = field(default_factory=dict)


class Experiment:
    """A scene as a function of its numbers.

    Args:
        scene: a validated scene.
        threads: largest number of threads; all cores if not given. Results do not depend on it.
        run: the run directory of the scene, if it has one.

    Attributes:
        built: the scene's particles and model.
        agent: what drives the actuators; None without a controller.
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
        self.agent = None if self.scene.controller is None else Agent(self.built, trained)
        self._episodes: EpisodeProblem | None = None
        if self.agent is not None and has_episodes(self.scene):
            self._episodes = EpisodeProblem(self.agent, threads=self.threads)
        self._params = make_params(self.built) if self.agent is None else self.agent.params
        self._given = GivenValues(self.built, self._params, self._auto)
        self.params: dict[str, Any] = {b.path: plain(b.initial) for b in self._params.blocks}

    @property
    def scene(self) -> Scene:
        """The resolved scene."""
        return self.built.scene

    def __repr__(self) -> str:
        return f"<cqrun problem: {self._in_words()}>"

    def _repr_html_(self) -> str:
        """Return the problem as a notebook shows it: what it is, and its parameters."""
        rows = "".join(
            f"<tr><td><code>{escape(path)}</code></td><td>{escape(_shown(value))}</td>"
            f"<td>{escape(self._unit(path))}</td></tr>"
            for path, value in self.params.items()
        )
        head = "<tr><th>parameter</th><th>start</th><th>unit</th></tr>"
        return f"<p><b>cqrun problem</b>: {escape(self._in_words())}</p><table>{head}{rows}</table>"

    def _in_words(self) -> str:
        scene, n = self.scene, len(self.built.particles.x)
        title = f"{scene.title}; " if scene.title else ""
        steps, params = scene.time.control_steps, len(self.params)
        return f"{title}{n:,} particles, {steps:,} control steps, {params} parameter{'s' * (params != 1)}"

    def _unit(self, path: str) -> str:
        unit = "" if path.startswith((CONTROLLER, "data.")) else leaf(self.scene, path).unit
        return "" if unit == "1" else unit

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
        params = {p: plain(np.array(v, float)) for p, v in values.items() if p not in followers}
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
            loss, gradient, aux = _of_episodes(self._episodes, self._given.stable(params))
            return loss, self._given.with_followers(gradient, params), aux
        if self.scene.data is None and not self.scene.objective:
            raise UsageError(
                "this scene has neither `data` nor an `objective`, so there is no loss: add one, or use simulate()"
            )
        if self.scene.predicts_only:
            raise UsageError("every recording is held out, so there is no loss: fit one of them, or use simulate()")
        problem, values = self._problem, self._given.stable(params)
        for case in problem.cases if params and self._auto else ():
            if not case.points:
                require_stable(case.built, case.own_values(values))
        problem.require_reached(values)
        losses, gradient = problem.losses_and_gradient(values)
        effort = {"recompute_factor": problem.effort.recompute, "peak_bytes": problem.effort.peak}
        aux = {"losses": losses, "gradient": effort}
        return float(sum(losses.values())), self._given.with_followers(gradient, params), aux

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

        measuring = Measuring(self.built)

        def keep(control: int, state: State) -> None:
            x[control], v[control] = state.x, state.v
            measuring.look(state, rollout.inputs, rollout.activation[max(control - 1, 0)])

        rollout = self.rollout_of(self.stable_values(params), self.chosen_goals(goals))
        with one_blas_thread():
            records = rollout.run(keep)
        measured = measuring.end(records)
        particles = self.built.particles
        bodies = {name: particles.of(name) for name in particles.names}
        found = {} if measured is None else {name: q.values for name, q in measured.quantities.items()}
        return Motion(np.arange(n_controls + 1) * step, x, v, bodies, rollout.activation.copy(), found)

    def vjp(
        self, params: Values | None = None, *, goals: Mapping[str, Any] | None = None, **bars: Array
    ) -> dict[str, Any]:
        """Return the gradient of a loss whose derivatives by the motion are known.

        Args:
            params: values by key path, as for `value_and_grad`.
            goals: as for `simulate`.
            bars: `x_bar` (T + 1, N, D), `v_bar`, `F_bar` (T + 1, N, D, D), `activation_bar` (T, A): derivatives of the
                loss by what `simulate` returns; `NAME_bar` (T + 1, n) for a quantity NAME of the section `measure`.

        Returns:
            The derivatives by every unknown, every parameter of the controller and every number in `params`.

        Raises:
            UsageError: a path, a name or a shape is wrong. RolloutError: the scene blows up.
        """
        from cqrun.jobs.own_loss import vjp

        wrong = [name for name in bars if not name.endswith("_bar")]
        if wrong or not bars:
            raise UsageError(f"vjp takes derivatives as x_bar, v_bar or NAME_bar{f', not {wrong[0]}' if wrong else ''}")
        return vjp(self, params, {name.removesuffix("_bar"): bar for name, bar in bars.items()}, goals)

    def loss(self, function: Callable[..., Any], of: Sequence[str] | None = None, backend: str = "numpy") -> OwnLoss:
        """Return a function of the motion as a loss, with `value_and_grad(params)`; see `OwnLoss`.

        Args:
            function: takes arrays by the names of its arguments: quantities of the section `measure`, `x`, `v`, `F`,
                `activation` or `time`. It returns (loss, {name: derivative}), or a scalar of the backend.
            of: names of the arrays, if they differ from those of the arguments.
            backend: numpy, torch or jax.

        Raises:
            UsageError: a name is not known, or the package of the backend is missing.
        """
        from cqrun.jobs.own_loss import OwnLoss

        return OwnLoss(self, function, of, backend)

    # --- for losses of one's own ----------------------------------------------------------------------------------

    def stable_values(self, params: Values | None) -> dict[str, Array]:
        """Return all values by key path; raise UsageError if some are wrong, or not stable with the substep."""
        return self._given.stable(params)

    def with_followers(self, gradient: dict[str, Array], params: Values | None) -> dict[str, Any]:
        """Return a gradient with the parts of followers added to their unknowns."""
        return self._given.with_followers(gradient, params)

    def chosen_goals(self, goals: Mapping[str, Any] | None) -> dict[str, Array]:
        """Return all goals, by default in the middle of their ranges; raise UsageError if one is wrong."""
        if not isinstance(goals, Mapping | None):
            raise UsageError(f"goals must be a mapping from goals to their entries, is {shown(goals)}")
        chosen = {} if self.agent is None else dict(self.agent.goals_in_the_middle)
        for name, entries in (goals or {}).items():
            if name not in chosen:
                raise UsageError(f"goals: there is no '{name}'{suggest(name, chosen)}; there are: {listed(chosen)}")
            goal = numbers_of(f"goals: '{name}'", entries)
            if goal.shape != chosen[name].shape or not np.isfinite(goal).all():
                raise UsageError(f"goals: '{name}' must be {len(chosen[name])} finite numbers, is {entries!r}")
            chosen[name] = goal
        return chosen

    def rollout_of(
        self, values: dict[str, Array], goals: Mapping[str, Array], *, model: Model | None = None, adjoint: bool = False
    ) -> Rollout:
        """Return a rollout that has not run yet, perhaps with another model."""
        if self.agent is not None:
            return self.agent.rollout(values, goals, self.threads, adjoint=adjoint, model=model)
        inputs = self.built.assembly.inputs(values)
        return make_rollout(model or self.built.model, inputs, threads=self.threads, adjoint=adjoint)

    @cached_property
    def _problem(self) -> FitProblem:
        return FitProblem(given_cases(self.built) or make_cases(self.built), self._params, threads=self.threads)


def _shown(value: Any) -> str:
    """Return a number, or the shape of an array, as text."""
    return f"{value:.6g}" if np.ndim(value) == 0 else f"array of shape {np.shape(value)}"


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


def _found_in(run: Path) -> dict[str, Any]:
    """Return the values that a run has found by path, from its controller's file or its result."""
    if (run / FILE).is_file():
        parameters, meta = read_controller(run / FILE)
        return {CONTROLLER + name: value for name, value in parameters.items()} | meta.get("unknowns", {})
    return dict(values_in(read_result(run)))


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
