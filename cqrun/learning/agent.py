"""An agent: the observers, controller, actuators and objective of a scene, with their rollouts.

An episode is one rollout with the policy and its own goals. A controller's file has its parameters and the facts that a
replay needs: the ranges of the observations, the length of the training runs, the actuators.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from cqrun.build.matter import matter_of
from cqrun.build.model import Built
from cqrun.controllers.policy import ControlPolicy, Limits
from cqrun.controllers.saved import load_controller, read_controller, save_controller
from cqrun.design.params import Block, Params, Plain
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import Inputs, LossBar, Model, Records
from cqrun.engine.rollout import Rollout
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.explain import listed
from cqrun.learning.actuator_placement import actuator_placement, require_same
from cqrun.learning.controller_fingerprint import controller_fingerprint, differences
from cqrun.learning.replay import SUBSTEPS, kept_values, require_fitting
from cqrun.objectives.term import Objective
from cqrun.observers.matter import Unfit
from cqrun.observers.observer import Observation
from cqrun.observers.rows import slices
from cqrun.observers.track import Track, TrackBar
from cqrun.plugin.contract import Array
from cqrun.running.side_by_side import Effort
from cqrun.running.unknowns import make_params
from cqrun.scene.files import unreadable_files
from cqrun.state import State
from cqrun.store.atomic import disk_errors

CONTROLLER = "controller."
"""Prefix of the names of the controller's blocks in key paths."""

FILE = "controller.npz"
"""File of a run's controller."""

Goals = Mapping[str, Array]
Values = Mapping[str, Array]


OBJECTIVE, CONSTRAINTS = 1, 2
"""Indices of `Agent.places`, the rows of the probe by their user; the observation has index 0."""


@dataclass(frozen=True)
class Mix:
    """A function of an episode: `loss` times its loss plus each constraint's value times its factor."""

    loss: float
    constraints: Mapping[str, float]


@dataclass(frozen=True)
class Attempt:
    """The results of one episode, without its grid and its records, which would be too large for many episodes.

    Attributes:
        loss: the loss of the objective.
        terms, constraints: values of the objective's terms and of the constraints, by name.
        goals: the goals of the episode.
        activation: (T, A) decisions of the policy.
        observations: (T, Z) inputs of the controller.
        growth_at: the control step where a gradient grew most, from `Rollout`.
        effort: the cost of its gradients.
    """

    loss: float
    terms: dict[str, float]
    constraints: dict[str, float]
    goals: Goals
    activation: Array
    observations: Array
    growth_at: int = -1
    effort: Effort = field(default_factory=Effort)


class Agent:
    """A scene's policy and objective, bound to its particles.

    Args:
        built: a scene with actuators and a controller; without an objective its loss is 0.
        trained: file of a trained controller; None for an untrained one.

    Attributes:
        params: the controller's parameters, then the scene's unknowns, at their start values.
        acting: values by path for a simulation: the controller's parameters at their start or from the file, and the
            values that were learned with them for every group or particle.
        changes: a sentence if parameters in the file mean something else here than in their training.
        starts: start values of the scene's unknowns for regularisers; in a replay those of the training, if known.
        model: the scene's model, which records what observers, objective and constraints need.

    Raises:
        SceneError: an observer, the controller or a term of the objective does not fit the scene.
        UsageError: the file has another controller.
    """

    def __init__(self, built: Built, trained: Path | None = None) -> None:
        self.built = built
        scene = built.scene
        assert scene.controller is not None
        self.controller: Any = scene.controller.value
        drive = built.assembly.actuation
        self.limits = Limits(drive.low, drive.high, drive.change, drive.neutral)
        self.actuators = [part.name for part in drive.parts]
        self.changes: list[str] = []
        meta = None if trained is None else self._read_meta(trained)
        self.starts = starts_of(built, {} if meta is None else meta.get("starts", {}))
        self.matter = matter_of(built, self.starts)
        # observers use the length of the training runs: the period of a clock does not change in a replay
        steps = self.matter.n_controls if meta is None else int(meta["n_controls"])
        self.learning = replace(self.matter, n_controls=steps)
        self.observation: Observation = self._bind(
            "observers",
            lambda: Observation.of({n: c.value for n, c in scene.observers.items()}, self.learning),  # type: ignore[misc]
        )
        self.objective: Objective = self._bind(
            "objective",
            lambda: Objective({n: c.value for n, c in scene.objective.items()}, self.matter),  # type: ignore[misc]
        )
        self.constraints: Objective = self._bind(
            "constraints",
            lambda: Objective({n: c.of.value for n, c in scene.constraints.items()}, self.matter),
        )
        users = (self.observation, self.objective, self.constraints)
        self.places = slices([user.rows.shape[0] for user in users])
        rows = sparse.vstack([user.rows for user in users]).tocsr()
        self.model = replace(built.model, probe=sparse.csr_array(rows))
        self.params = self._params()
        self.acting = {b.path: np.array(b.initial) for b in self.params.blocks if b.path.startswith(CONTROLLER)}
        if trained is not None and meta is not None:
            self.acting = self._load(trained, meta)

    def _bind(self, key: str, make: Callable[[], Any]) -> Any:
        if unreadable := unreadable_files(self.built.scene, (key,)):
            raise SceneError(unreadable)
        try:
            return make()
        except Unfit as error:
            path = f"{key}.{error.name}"
            raise SceneError([Problem(self.built.scene.where(path), path, str(error))]) from error
        except UsageError as error:
            raise SceneError([Problem(self.built.scene.where(key), key, str(error))]) from error

    def _params(self) -> Params:
        rng = np.random.default_rng([self.built.scene.seed])
        limits, n_in = self.limits, self.observation.size
        self.blocks = self._bind(
            "controller",
            lambda: self.controller.blocks(
                n_in, len(limits.low), self.learning.n_controls, limits.low, limits.high, limits.neutral, rng
            ),
        )
        blocks: list[Block] = [
            Plain(CONTROLLER + b.name, b.lower, b.upper, False, np.array(b.initial)) for b in self.blocks
        ]
        return Params((*blocks, *make_params(self.built).blocks))

    # --- a controller's file ------------------------------------------------------------------------------------

    def _facts(self) -> dict[str, Any]:
        """Return the facts that must be the same in a replay of the controller."""
        return {
            "controller": self.controller.name,
            "actuators": self.actuators,
            "observers": list(self.built.scene.observers),
            "control_step": self.built.scene.time.control_step,
        }

    def save(self, path: Path, values: Values) -> None:
        """Write the controller's parameters and the other learned values to a file; RunError if the disk is full."""
        parameters = {p.removeprefix(CONTROLLER): v for p, v in values.items() if p.startswith(CONTROLLER)}
        meta = self._facts() | {
            "middle": self.observation.middle.tolist(),
            "half": self.observation.half.tolist(),
            "n_controls": self.learning.n_controls,
            SUBSTEPS: self.built.model.substeps,
            "acted_on": actuator_placement(self.built),
            "meaning": self._fingerprint(),
            "unknowns": _of_scene(values),
            "starts": _of_scene(self.starts),
        }
        with disk_errors(path):
            save_controller(path, parameters, meta)

    def _fingerprint(self) -> dict[str, Any]:
        return controller_fingerprint(self.built, [block.name for block in self.blocks])

    def _read_meta(self, path: Path) -> dict[str, Any]:
        """Return the facts in a controller's file; raise UsageError if they do not fit this scene."""
        _, meta = read_controller(path)
        absent = {*self._facts(), "middle", "half", "n_controls", "unknowns"} - meta.keys()
        if absent:
            raise UsageError(f"{path}: lacks the controller's {listed(sorted(absent))}: it was not written by a run")
        for name, here in self._facts().items():
            if meta[name] != here:
                then, now = (listed(v) if isinstance(v, list) else v for v in (meta[name], here))
                raise UsageError(
                    f"{path}: was trained with another {name.replace('_', ' ').removesuffix('s')}: {then}; this scene "
                    f"has {now}"
                )
        if "acted_on" in meta:
            require_same(path, meta["acted_on"], self.built, meta["unknowns"])
        return meta

    def _load(self, path: Path, meta: Mapping[str, Any]) -> dict[str, Array]:
        """Set the ranges of the observations from a file, and return its parameters and learned values."""
        parameters, _ = load_controller(path, self.blocks)
        middle, half = np.array(meta["middle"], float), np.array(meta["half"], float)
        if not len(middle) == len(half) == self.observation.size:
            raise UsageError(
                f"{path}: holds a controller of another shape: it saw {len(middle)} numbers, and this scene's "
                f"observers give {self.observation.size}"
            )
        self.observation.middle, self.observation.half = middle, half
        if "meaning" in meta:
            self.changes = differences(path, meta["meaning"], self._fingerprint())
        kept = kept_values(path)
        require_fitting(path, kept, self.params)
        return {CONTROLLER + name: array for name, array in parameters.items()} | kept

    # --- rollouts -----------------------------------------------------------------------------------------------

    @property
    def goals_in_the_middle(self) -> Goals:
        """All goals in the middle of their ranges."""
        return {name: np.array(goal.position) for name, goal in self.built.scene.goals.items()}

    def wanted(self, goals: Goals) -> dict[str, Any]:
        """Return the goal positions [m] for the attributes of a trajectory."""
        return self.objective.wanted(goals)

    def rollout(
        self, values: Values, goals: Goals, threads: int, *, adjoint: bool = False, model: Model | None = None
    ) -> Rollout:
        """Return a rollout with the policy and these values, which has not run yet.

        Args:
            model: replaces the agent's, whose rows must be the first of its probe.
        """
        parameters = {p.removeprefix(CONTROLLER): v for p, v in values.items() if p.startswith(CONTROLLER)}
        policy = ControlPolicy(
            self.observation, self.controller, parameters, self.limits, goals, self.matter.control_step, self.model.dim
        )
        inputs = self.built.assembly.inputs({p: v for p, v in values.items() if not p.startswith(CONTROLLER)})
        inputs.state.memory = policy.memory.copy()
        if not self.controller.learned and self.model.settled:
            first = self.controller.act(parameters, np.zeros(0), 0, 0.0)
            inputs.activation[0] = policy.activate(first, np.zeros(0), policy.memory)[0]
        return make_rollout(model or self.model, inputs, threads=threads, adjoint=adjoint, policy=policy)

    def track(
        self, records: Records, rollout: Rollout, goals: Goals, *, activation: Array | None = None,
        user: int = OBJECTIVE,
    ) -> Track:  # fmt: skip
        """Return a run in the form of the objective or the constraints; `activation` (T, A) replaces the rollout's."""
        at = self.places[user]
        return Track(
            records.x[:, at], records.v[:, at], records.C[:, at], records.F[:, at],
            rollout.activation if activation is None else activation, goals, self.matter.control_step,
            self.built.assembly.design(rollout.inputs), records.held, rollout.inputs.strength, rollout.inputs.rest,
            rollout.inputs.terms, rollout.inputs.weights, rollout.inputs.state.x,
            rollout.inputs.friction, records.rigid,
        )  # fmt: skip

    def judged(self, rollout: Rollout, records: Records, goals: Goals) -> Attempt:
        """Return the results of an episode that has run."""
        return self._judged(rollout, *self._tracks(rollout, records, goals))

    def _tracks(self, rollout: Rollout, records: Records, goals: Goals) -> tuple[Track, Track]:
        """Return a run in the form of the objective, and in that of the constraints."""
        return self.track(records, rollout, goals), self.track(records, rollout, goals, user=CONSTRAINTS)

    def _judged(self, rollout: Rollout, track: Track, constraints_track: Track) -> Attempt:
        terms, constraints = self.objective.values(track), self.constraints.values(constraints_track)
        policy: Any = rollout.policy
        loss, activation = self.objective.weighted_sum(terms), rollout.activation.copy()
        return Attempt(loss, terms, constraints, track.goals, activation, np.array(policy.observations))

    def attempt(
        self, values: Values, goals: Goals, threads: int, observe: Callable[[int, State], None] | None = None
    ) -> Attempt:
        """Run one episode forward; raise RolloutError if it blows up."""
        rollout = self.rollout(values, goals, threads)
        return self.judged(rollout, rollout.run(observe), goals)

    def attempt_with_gradients(
        self, values: Values, goals: Goals, threads: int, budget: int, mixes: Callable[[Attempt], Sequence[Mix]]
    ) -> tuple[Attempt, list[dict[str, Array]]]:
        """Run one episode forward once, and backward once for each of several functions of it.

        Args:
            values: the controller's parameters, and any other numbers that gradients reach, by path.
            goals: goals of the episode.
            threads: number of threads.
            budget: memory for kept states [bytes].
            mixes: returns the functions of the episode to differentiate.

        Returns:
            The episode, and the gradients by path.
        """
        rollout = self.rollout(values, goals, threads, adjoint=True)
        rollout.model = replace(rollout.model, memory_budget=budget)
        attempts: list[Attempt] = []
        functions: list[tuple[bool, TrackBar]] = []  # of each: whether it has a sweep, and the other cotangents

        def loss_bars(records: Records, final: State) -> Iterator[LossBar]:
            tracks = self._tracks(rollout, records, goals)
            attempts.append(self._judged(rollout, *tracks))
            for mix in mixes(attempts[0]):
                loss_bar, beside = self._bars(records, *tracks, mix)
                functions.append((loss_bar is not None, beside))
                if loss_bar is not None:
                    yield loss_bar

        of_scene = {p: v for p, v in values.items() if not p.startswith(CONTROLLER)}
        _, sweeps = rollout.gradients(loss_bars)
        waiting, gradients = iter(sweeps), []
        for swept, beside in functions:
            if not swept:  # it depends on the design only
                inputs_bar, parameters_bar = Inputs.zeros_like(rollout.inputs), rollout.policy.parameters_zero()  # type: ignore[union-attr]
            else:
                sweep = next(waiting)
                inputs_bar, parameters_bar = sweep.inputs_bar(), sweep.parameters_bar
            self.built.assembly.add_beside(inputs_bar, beside)
            by_controller = {CONTROLLER + name: bar for name, bar in parameters_bar.items()}
            gradients.append(by_controller | self.built.assembly.gradient(of_scene, inputs_bar))
        return replace(attempts[0], growth_at=rollout.growth_at, effort=Effort.of(rollout)), gradients

    def _bars(
        self, records: Records, track: Track, constraints_track: Track, mix: Mix
    ) -> tuple[LossBar | None, TrackBar]:
        """Return a function's cotangents: of the rollout's results, None for zero, and of the inputs of its terms."""
        full = records.zeros_like()
        total, moves = TrackBar(), False
        for user, bar in (
            (OBJECTIVE, self.objective.loss_vjp(track, mix.loss) if mix.loss else TrackBar()),
            (CONSTRAINTS, self.constraints.values_vjp(constraints_track, mix.constraints)),
        ):
            for name in ("x", "v", "C", "F"):
                part = getattr(bar, name)
                if part is not None:
                    getattr(full, name)[:, self.places[user]], moves = part, True
            full.add_by_name(bar.by_name)
            moves = moves or any(bar.by_name.values())
            if bar.activation is not None:
                total.activation = bar.activation + (0.0 if total.activation is None else total.activation)
            total.add_inputs_of(bar)
        moves = moves or total.activation is not None
        return (LossBar(full, activation=total.activation) if moves else None), total


def _of_scene(values: Values) -> dict[str, Any]:
    """Return the values that are not the controller's in a form for JSON."""
    return {p: np.asarray(v).tolist() for p, v in values.items() if not p.startswith(CONTROLLER)}


def starts_of(built: Built, trained: Mapping[str, Any]) -> dict[str, Array]:
    """Return the start values of the unknowns and their followers by path; in a replay those of the training."""
    unknowns = make_params(built)
    starts = unknowns.unpack(unknowns.start)
    then = {path: np.array(value, float) for path, value in trained.items()}
    return starts | {path: value for path, value in then.items() if value.shape == np.shape(starts.get(path, 0.0))}
