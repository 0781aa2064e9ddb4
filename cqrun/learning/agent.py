"""A scene that acts: its observers, controller, actuators and objective as one thing that rolls out.

An episode is one rollout under the policy, with its own goals. What a controller learned is kept in a file with all
that it must find again: the ranges of its observations, the length of the runs it was trained in, its actuators.
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
from cqrun.engine.model import Inputs, LossBar, Records
from cqrun.engine.rollout import Rollout
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.explain import listed
from cqrun.learning.actuator_placement import acted_on, require_same
from cqrun.learning.controller_fingerprint import differences, meaning_of
from cqrun.learning.replay import SUBSTEPS, kept_values, require_fitting
from cqrun.objectives.term import Objective, Track, TrackBar
from cqrun.observers.matter import Unfit
from cqrun.observers.observer import Observation
from cqrun.observers.rows import slices
from cqrun.plugin.contract import Array
from cqrun.running.side_by_side import Effort
from cqrun.running.unknowns import make_params
from cqrun.scene.files import unreadable_files
from cqrun.state import State
from cqrun.store.atomic import disk_errors

CONTROLLER = "controller."
"""Before the name of a block of the controller, as before a key path of the scene."""

FILE = "controller.npz"
"""Where a run keeps its controller."""

Goals = Mapping[str, Array]
Values = Mapping[str, Array]


OBJECTIVE, CONSTRAINTS = 1, 2
"""Who asked for which of the probe's rows; the observation's are the first."""


@dataclass(frozen=True)
class Mix:
    """A function of an episode: `loss` times its loss, and each constraint's term times its factor."""

    loss: float
    constraints: Mapping[str, float]


@dataclass(frozen=True)
class Attempt:
    """What is left of one rollout under the policy: not its grid, nor its records, which many episodes could not keep.

    Attributes:
        loss: of the objective.
        terms, held: values of its terms, and of the constraints', by name.
        goals: of the episode.
        activation: (T, A) as the policy decided.
        saw: (T, Z) what the controller got.
        growth_at: the control step where a gradient grew most, as `Rollout` has it.
        effort: what its gradients cost.
    """

    loss: float
    terms: dict[str, float]
    held: dict[str, float]
    goals: Goals
    activation: Array
    saw: Array
    growth_at: int = -1
    effort: Effort = field(default_factory=Effort)


class Agent:
    """A scene's policy and objective, bound to its particles.

    Args:
        built: a scene with actuators and a controller; without an objective its loss is 0.
        trained: file of a controller that is to act again; without, one acts that has yet to learn.

    Attributes:
        params: the controller's parameters, then the scene's unknowns, as they start.
        acting: values by path that it acts with where nothing is learned: the controller's parameters as they start
            or as the file has them, and what was learned with them for every group or particle.
        otherwise: a sentence where parameters in the file mean something else here than in their training.
        starts: of the scene's unknowns, from which changes count: in a replay those of the training, if the file says.
        model: the scene's, recording what observers and objective need.

    Raises:
        SceneError: an observer, the controller or a term of the objective does not fit the scene.
        UsageError: the file is of another controller.
    """

    def __init__(self, built: Built, trained: Path | None = None) -> None:
        self.built = built
        scene = built.scene
        assert scene.controller is not None
        self.controller: Any = scene.controller.value
        drive = built.assembly.actuation
        self.limits = Limits(drive.low, drive.high, drive.change, drive.neutral)
        self.actuators = [part.name for part in drive.parts]
        self.otherwise: list[str] = []
        said = None if trained is None else self._noted(trained)
        self.starts = starts_of(built, {} if said is None else said.get("starts", {}))
        self.matter = matter_of(built, self.starts)
        # what observers take for the run is the one they were trained in: a clock's period does not stretch
        steps = self.matter.n_controls if said is None else int(said["n_controls"])
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
        asking = (self.observation, self.objective, self.constraints)
        self.places = slices([part.rows.shape[0] for part in asking])
        rows = sparse.vstack([part.rows for part in asking]).tocsr()
        self.model = replace(built.model, probe=sparse.csr_array(rows))
        self.params = self._params()
        self.acting = {b.path: np.array(b.initial) for b in self.params.blocks if b.path.startswith(CONTROLLER)}
        if trained is not None and said is not None:
            self.acting = self._taken_up(trained, said)

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
        own: list[Block] = [
            Plain(CONTROLLER + b.name, b.lower, b.upper, False, np.array(b.initial)) for b in self.blocks
        ]
        return Params((*own, *make_params(self.built).blocks))

    # --- a controller's file ------------------------------------------------------------------------------------

    def _facts(self) -> dict[str, Any]:
        """Return what must be the same where a controller acts again."""
        return {
            "controller": self.controller.name,
            "actuators": self.actuators,
            "observers": list(self.built.scene.observers),
            "control_step": self.built.scene.time.control_step,
        }

    def save(self, path: Path, values: Values) -> None:
        """Write a controller's parameters, and the values learned beside them, to a file; RunError on a full disk."""
        parameters = {p.removeprefix(CONTROLLER): v for p, v in values.items() if p.startswith(CONTROLLER)}
        meta = self._facts() | {
            "middle": self.observation.middle.tolist(),
            "half": self.observation.half.tolist(),
            "n_controls": self.learning.n_controls,
            SUBSTEPS: self.built.model.substeps,
            "acted_on": acted_on(self.built),
            "meaning": self._meaning(),
            "unknowns": _of_scene(values),
            "starts": _of_scene(self.starts),
        }
        with disk_errors(path):
            save_controller(path, parameters, meta)

    def _meaning(self) -> dict[str, Any]:
        return meaning_of(self.built, [block.name for block in self.blocks])

    def _noted(self, path: Path) -> dict[str, Any]:
        """Return what a file says of its controller; UsageError where that is not this scene's."""
        _, meta = read_controller(path)
        absent = {*self._facts(), "middle", "half", "n_controls", "unknowns"} - meta.keys()
        if absent:
            raise UsageError(f"{path}: does not say the controller's {listed(sorted(absent))}: no run wrote it")
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

    def _taken_up(self, path: Path, said: Mapping[str, Any]) -> dict[str, Array]:
        """Take the ranges that a file has, and return the values that were learned for more than one number each."""
        parameters, _ = load_controller(path, self.blocks)
        middle, half = np.array(said["middle"], float), np.array(said["half"], float)
        if not len(middle) == len(half) == self.observation.size:
            raise UsageError(
                f"{path}: holds a controller of another shape: it saw {len(middle)} numbers, and this scene's "
                f"observers give {self.observation.size}"
            )
        self.observation.middle, self.observation.half = middle, half
        if "meaning" in said:
            self.otherwise = differences(path, said["meaning"], self._meaning())
        kept = kept_values(path)
        require_fitting(path, kept, self.params)
        return {CONTROLLER + name: array for name, array in parameters.items()} | kept

    # --- rollouts -----------------------------------------------------------------------------------------------

    @property
    def goals_in_the_middle(self) -> Goals:
        """Every goal at its position, the middle of its range."""
        return {name: np.array(goal.position) for name, goal in self.built.scene.goals.items()}

    def wanted(self, goals: Goals) -> dict[str, Any]:
        """Return what a trajectory says of where its bodies should go [m]."""
        return self.objective.wanted(goals)

    def rollout(self, values: Values, goals: Goals, threads: int, *, adjoint: bool = False) -> Rollout:
        """Return a rollout under the policy with these values; nothing is run yet."""
        parameters = {p.removeprefix(CONTROLLER): v for p, v in values.items() if p.startswith(CONTROLLER)}
        policy = ControlPolicy(
            self.observation, self.controller, parameters, self.limits, goals, self.matter.control_step, self.model.dim
        )
        inputs = self.built.assembly.inputs({p: v for p, v in values.items() if not p.startswith(CONTROLLER)})
        inputs.state.memory = policy.memory.copy()
        return Rollout(self.model, inputs, threads=threads, adjoint=adjoint, policy=policy)

    def track(
        self, records: Records, rollout: Rollout, goals: Goals, *, activation: Array | None = None,
        asking: int = OBJECTIVE,
    ) -> Track:  # fmt: skip
        """Return a run as the objective sees it, or the constraints; `activation` (T, A) if not the rollout's own."""
        at = self.places[asking]
        return Track(
            records.x[:, at], records.v[:, at], records.C[:, at], records.F[:, at],
            rollout.activation if activation is None else activation, goals, self.matter.control_step,
            self.built.assembly.design(rollout.inputs),
        )  # fmt: skip

    def judged(self, rollout: Rollout, records: Records, goals: Goals) -> Attempt:
        """Return an episode that has been run, with its loss and what its constraints hold."""
        return self._judged(rollout, *self._tracks(rollout, records, goals))

    def _tracks(self, rollout: Rollout, records: Records, goals: Goals) -> tuple[Track, Track]:
        """Return a run as the objective sees it, and as the constraints do."""
        return (
            self.track(records, rollout, goals, asking=OBJECTIVE),
            self.track(records, rollout, goals, asking=CONSTRAINTS),
        )

    def _judged(self, rollout: Rollout, track: Track, held_track: Track) -> Attempt:
        terms, held = self.objective.values(track), self.constraints.values(held_track)
        policy: Any = rollout.policy
        loss, activation = self.objective.weighted_sum(terms), rollout.activation.copy()
        return Attempt(loss, terms, held, track.goals, activation, np.array(policy.observations))

    def attempt(
        self, values: Values, goals: Goals, threads: int, observe: Callable[[int, State], None] | None = None
    ) -> Attempt:
        """Run one episode forward; RolloutError where it blows up."""
        rollout = self.rollout(values, goals, threads)
        return self.judged(rollout, rollout.run(observe), goals)

    def attempt_with_gradients(
        self, values: Values, goals: Goals, threads: int, budget: int, mixes: Callable[[Attempt], Sequence[Mix]]
    ) -> tuple[Attempt, list[dict[str, Array]]]:
        """Run one episode forward once, and backward once for each of several functions of it.

        Args:
            values: the controller's parameters, and any other numbers that gradients reach, by path.
            goals: of the episode.
            threads: to use.
            budget: for states that are kept [bytes].
            mixes: of the episode, what is differentiated: sums of the loss and of constraints, each by its factors.

        Returns:
            The episode, and the gradients by path.
        """
        rollout = self.rollout(values, goals, threads, adjoint=True)
        rollout.model = replace(self.model, memory_budget=budget)
        found: list[Attempt] = []
        asked: list[tuple[bool, Array | None]] = []  # of each function, whether it has a sweep, and its design's bar

        def loss_bars(records: Records, final: State) -> Iterator[LossBar]:
            tracks = self._tracks(rollout, records, goals)
            found.append(self._judged(rollout, *tracks))
            for mix in mixes(found[0]):
                loss_bar, design_bar = self._bars(records, *tracks, mix)
                asked.append((loss_bar is not None, design_bar))
                if loss_bar is not None:
                    yield loss_bar

        own = {p: v for p, v in values.items() if not p.startswith(CONTROLLER)}
        _, sweeps = rollout.gradients(loss_bars)
        waiting, gradients = iter(sweeps), []
        for swept, design_bar in asked:
            if not swept:  # of the design alone
                inputs_bar, parameters_bar = Inputs.zeros_like(rollout.inputs), rollout.policy.parameters_zero()  # type: ignore[union-attr]
            else:
                sweep = next(waiting)
                inputs_bar, parameters_bar = sweep.inputs_bar(), sweep.parameters_bar
            if design_bar is not None:
                self.built.assembly.add_design_bar(inputs_bar, design_bar)
            by_controller = {CONTROLLER + name: bar for name, bar in parameters_bar.items()}
            gradients.append(by_controller | self.built.assembly.gradient(own, inputs_bar))
        return replace(found[0], growth_at=rollout.growth_at, effort=Effort.of(rollout)), gradients

    def _bars(self, records: Records, track: Track, held_track: Track, mix: Mix) -> tuple[LossBar | None, Array | None]:
        """Return the cotangents of what the rollout gives, and of the design (Q, N), for one function of an episode.

        None where it depends on nothing of that kind.
        """
        full = records.zeros_like()
        whole, moves = TrackBar(), False
        for asking, bar in (
            (OBJECTIVE, self.objective.loss_vjp(track, mix.loss) if mix.loss else TrackBar()),
            (CONSTRAINTS, self.constraints.values_vjp(held_track, mix.constraints)),
        ):
            for name in ("x", "v", "C", "F"):
                part = getattr(bar, name)
                if part is not None:
                    getattr(full, name)[:, self.places[asking]], moves = part, True
            for name in ("activation", "design"):
                own, total = getattr(bar, name), getattr(whole, name)
                if own is not None:
                    setattr(whole, name, own if total is None else total + own)
        moves = moves or whole.activation is not None
        return (LossBar(full, activation=whole.activation) if moves else None), whole.design


def _of_scene(values: Values) -> dict[str, Any]:
    """Return the values that are not the controller's, as JSON has them."""
    return {p: np.asarray(v).tolist() for p, v in values.items() if not p.startswith(CONTROLLER)}


def starts_of(built: Built, trained: Mapping[str, Any]) -> dict[str, Array]:
    """Return where the unknowns, and what follows them, start by path: in a replay where they did in the training."""
    unknowns = make_params(built)
    own = unknowns.unpack(unknowns.start)
    then = {path: np.array(value, float) for path, value in trained.items()}
    return own | {path: value for path, value in then.items() if value.shape == np.shape(own.get(path, 0.0))}
