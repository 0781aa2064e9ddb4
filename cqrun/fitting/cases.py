"""Cases: the rollouts that a fit compares with data, one a recording or a sequence of activations.

A case is the scene with a recording's overrides and length, its model, and what its records are compared with.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from cqrun.build.model import Built, build
from cqrun.engine.model import Inputs, LossBar, Model, Records
from cqrun.engine.rollout import Rollout
from cqrun.errors import DataError, Problem, RolloutError, RunError, SceneError
from cqrun.fitting.marker_misfit import MarkerObjective
from cqrun.fitting.points import Points, centroid, markers, particles
from cqrun.fitting.target import TargetObjective
from cqrun.plugin.contract import Array
from cqrun.running.runs import data_files
from cqrun.running.side_by_side import Effort
from cqrun.scene.data import Recording as RecordingSpec
from cqrun.scene.paths import canonical, with_values
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import body_of, bounds_of, starts, truths
from cqrun.scene.world_and_time import ON_CONTROL_STEP
from cqrun.state import State
from cqrun.store.alignment import Measured, measure, require_before_motion
from cqrun.store.atomic import disk_errors, make_directory
from cqrun.store.marker_csv import write_csv
from cqrun.store.recording import Recording
from cqrun.store.recordings import read_recording
from cqrun.store.run import RunDirectory
from cqrun.store.synthetic import make_synthetic
from cqrun.units import METRES

Objective = MarkerObjective | TargetObjective

SYNTHETIC = "synthetic"
"""Folder of a run that holds the data it made for itself."""


@dataclass(frozen=True)
class Case:
    """One rollout and what its records are compared with.

    Attributes:
        name: of the recording or sequence.
        built: the scene with this case's overrides; its model records the probe.
        objectives: one a recording; copies of one sequence share the rollout.
        start_path: key path of the recording's start, or None.
        start: where it begins [s].
        holdout: predicted, never fitted.
        measured: the recordings in the scene's frame, for plots.
    """

    name: str
    built: Built
    objectives: tuple[Objective, ...]
    start_path: str | None = None
    start: float = 0.0
    holdout: bool = False
    measured: tuple[Measured, ...] = ()

    def inputs(self, values: Mapping[str, Array]) -> Inputs:
        """Return the engine's inputs for values by path."""
        return self.built.assembly.inputs(values)

    def start_of(self, values: Mapping[str, Array]) -> float:
        """Return the recording's start [s]."""
        path = self.start_path
        return self.start if path is None or path not in values else float(values[path])

    def run(
        self,
        values: Mapping[str, Array],
        threads: int = 1,
        observe: Callable[[int, State], None] | None = None,
    ) -> Records:
        """Run forward, `observe` called with every control step and its state; return the records."""
        return Rollout(self.built.model, self.inputs(values), threads=threads).run(observe)

    def residuals(self, record: Records, values: Mapping[str, Array]) -> list[Array]:
        """Return every objective's residuals [m]."""
        start = self.start_of(values)
        return [
            o.residuals(record, start) if isinstance(o, MarkerObjective) else o.residuals(record)
            for o in self.objectives
        ]

    def still_losses(self) -> Array:
        """Return every objective's loss for bodies that stay where they are (K,) [m^2]."""
        model, probe = self.built.model, self.built.model.probe
        assert probe is not None
        shape = (model.n_controls + 1, probe.shape[0], model.dim)
        zeros = np.zeros((*shape, model.dim))
        record = Records(
            np.broadcast_to(probe @ self.built.particles.x, shape), np.zeros(shape), zeros, zeros + np.eye(model.dim)
        )
        return np.array(
            [o.loss(record, self.start) if isinstance(o, MarkerObjective) else o.loss(record) for o in self.objectives]
        )

    def gradient(
        self, values: Mapping[str, Array], weights: Array, threads: int = 1, budget: int | None = None
    ) -> tuple[float, dict[str, Array], Effort]:
        """Return sum of weights[k] * loss_k, its gradient by path, and what that cost."""
        model = self.built.model if budget is None else replace(self.built.model, memory_budget=budget)
        start = self.start_of(values)
        rollout = Rollout(model, self.inputs(values), threads=threads, adjoint=True)
        found: dict[str, float] = {"loss": 0.0, "start": 0.0}

        def loss_bar(records: Records, final: Any) -> LossBar:
            total = Records.zeros(model.n_controls, records.x.shape[1], model.dim)
            for weight, objective in zip(weights, self.objectives, strict=True):
                if isinstance(objective, MarkerObjective):
                    found["loss"] += weight * objective.loss(records, start)
                    bar, start_bar = objective.loss_vjp(records, start, weight)
                    found["start"] += start_bar
                else:
                    found["loss"] += weight * objective.loss(records)
                    bar = objective.loss_vjp(records, weight)
                for out, part in zip(total, bar, strict=True):
                    out += part
            return LossBar(total)

        _, inputs_bar = rollout.gradient(loss_bar)
        gradient = self.built.assembly.gradient(values, inputs_bar)
        if self.start_path in gradient:
            gradient[str(self.start_path)] += found["start"]
        return found["loss"], gradient, Effort.of(rollout)


def make_cases(built: Built, directory: Path | None = None) -> list[Case]:
    """Return the cases of a scene's data.

    Args:
        built: the scene, its substeps resolved.
        directory: where synthetic data is kept; without one it is made in memory.

    Raises:
        SceneError: data that cannot be used.
    """
    data = built.scene.data
    if data is None:
        where = built.scene.where("")
        raise SceneError([Problem(where, "data", "there is none: give `recordings`, a `target` or `synthetic`")])
    if data.recordings is not None:
        return _all_recorded(built, data.recordings)
    if data.target is not None:
        return [_targeted(built)]
    return _synthetic(built, directory)


def given_cases(built: Built) -> list[Case] | None:
    """Return the cases of recordings or a target, or None where the run makes its own data.

    Read before there is a run: one whose data cannot be used leaves nothing behind.

    Raises:
        SceneError: data that is missing or cannot be used, or of which nothing is fitted.
    """
    data = built.scene.data
    if data is None or data.synthetic is not None:
        return None
    data_files(built.scene)  # all that are missing are told at once
    cases = make_cases(built)
    if all(case.holdout for case in cases):
        message = "every recording is held out: nothing is left to fit"
        raise SceneError([Problem(built.scene.where("data.recordings"), "data.recordings", message)])
    return cases


def own_warnings(built: Built, cases: Sequence[Case]) -> Iterator[str]:
    """Yield the warnings of recordings' own scenes that are not the scene's."""
    told = {warning.message for warning in built.warnings}
    for case in cases:
        yield from (f"{case.name}: {warning}" for warning in case.built.warnings if warning.message not in told)


def made_cases(run: RunDirectory, built: Built) -> list[Case]:
    """Return the cases of the data that a run makes with the true values.

    Raises:
        RunError: the scene blows up with them.
    """
    try:
        return make_cases(built, run.path)
    except RolloutError as error:
        run.finish("failed", f"data.synthetic.truth: {error}")
        raise RunError(f"{run.path}: data.synthetic.truth: {error}") from error


# --- recordings ---------------------------------------------------------------------------------------------


def _all_recorded(built: Built, specs: Mapping[str, RecordingSpec]) -> list[Case]:
    """Return the cases of all recordings, or raise what is wrong with any of them."""
    cases, problems = [], []
    for name, spec in specs.items():
        try:
            cases.append(_recorded(built, name, spec))
        except DataError as error:
            path = f"data.recordings.{name}"
            problems.append(Problem(built.scene.where(path), path, str(error)))
    if problems:
        raise SceneError(problems)
    return cases


def _recorded(built: Built, name: str, spec: RecordingSpec) -> Case:
    scene, path = built.scene, f"data.recordings.{name}"
    step = scene.time.control_step
    length = scene.time.duration if spec.length is None else spec.length
    steps = round(length / step)
    if abs(steps * step - length) > ON_CONTROL_STEP * length:
        raise DataError(
            f"`length`, {length:.10g} s, is no multiple of the control step {step:.10g} s; the nearest is "
            f"{max(1, steps) * step:.10g} s"
        )
    own = build(with_values(scene, {**_signals(scene), **spec.overrides, "time.duration": steps * step}))
    _require_same_particles(built, own)
    recording = read_recording(scene.resolve_path(spec.file), units=spec.units)
    still = None if spec.still is None else (spec.still[0], spec.still[1])
    measured = measure(recording, {k: np.array(v) for k, v in spec.markers.items()}, still)
    observer = _observe_markers(own, spec.body, dict(zip(measured.names, measured.rest, strict=True)))
    if measured.absolute:
        _require_near(own, spec.body, measured)
    start_path = f"{path}.start"
    begins = starts(scene).get(start_path, spec.start)  # an unknown's own start, or one that it follows
    objective = MarkerObjective(
        observer, measured.names, measured.time, measured.values, control_step=step, steps=steps,
        start=begins, start_bounds=bounds_of(scene, start_path),
        skip=spec.skip, still=measured.still, absolute=measured.absolute, weight=spec.weight, source=measured.source,
    )  # fmt: skip
    if still is not None:
        earliest, latest = objective.start_bounds
        require_before_motion(still, earliest, latest + steps * step, measured.source)
    return Case(name, _probed(own, spec.body, observer), (objective,), start_path, begins, spec.holdout, (measured,))


def _signals(scene: Scene) -> dict[str, float]:
    """Return what keeps the scene's signals as they are in a recording of another length."""
    signals = scene.activation
    return {} if signals is None or signals.over is not None else {"activation.over": scene.time.duration}


def _require_same_particles(built: Built, own: Built) -> None:
    """Refuse overrides that change the particles of a body of which each, or a field over them, is unknown."""
    for path, unknown in built.scene.unknowns.items():
        for body in {body_of(built.scene, canonical(built.scene, p)) for p in (path, *unknown.also)} - {""}:
            if unknown.per in ("particle", "field"):
                ours, theirs = (b.particles.x[b.particles.of(body)] for b in (built, own))
                if not np.array_equal(ours, theirs):
                    raise DataError(
                        f"its overrides change the particles of '{body}', each of which has a value of the unknown "
                        f"'{path}': leave the body's particles as they are, or use `per: body`"
                    )


def _require_near(built: Built, body: str, measured: Measured) -> None:
    """Refuse positions that are never near where their markers are at rest."""
    x = built.particles.x[built.particles.of(body)]
    reach = max(float(np.linalg.norm(x.max(axis=0) - x.min(axis=0))), built.particles.spacing[body])  # of one particle
    away = np.linalg.norm(measured.values - measured.rest, axis=2)
    for name, distances in zip(measured.names, away.T, strict=True):
        nearest = np.nanmin(distances, initial=np.inf)
        if np.isfinite(nearest) and nearest > reach:
            raise DataError(
                f"{measured.source}: marker '{name}' is never nearer than {nearest:.3g} m to where it is at rest, and "
                f"the body is {reach:.3g} m across: {_advice(measured, reach)}"
            )


def _advice(measured: Measured, reach: float) -> str:
    """Return what would bring positions near where their markers are at rest."""
    for unit, factor in METRES.items():
        away = np.nanmin(np.linalg.norm(factor * measured.values - measured.rest, axis=2), axis=0)  # all were seen
        near = np.minimum(reach, 0.5 * np.linalg.norm(measured.rest, axis=1))  # the origin alone tells nothing
        if unit != "m" and (away <= near).all():
            return f"the file looks as if it is in {unit}: say `units: {unit}`"
    return "without `still` frames positions are in the scene's own frame; give `still`, or mend the rest positions"


def _observe_markers(built: Built, body: str, rest: Mapping[str, Array]) -> Points:
    """Return the observer of markers, by name and rest position, on the body that carries them."""
    x = built.particles.x[built.particles.of(body)]
    reach = max(float(np.linalg.norm(x.max(axis=0) - x.min(axis=0))), built.particles.spacing[body])  # of one particle
    observer = markers(np.array(list(rest.values())), x, built.particles.spacing[body])
    stems = np.zeros(len(rest)) if observer.stems is None else np.linalg.norm(observer.stems, axis=1)
    for name, stem in zip(rest, stems, strict=True):
        if stem > reach:
            raise DataError(
                f"marker '{name}' is {stem:.3g} m from the body '{body}', which is {reach:.3g} m across: "
                "give its rest position in the scene's own coordinates, in metres"
            )
    return observer


def _probed(built: Built, body: str, observer: Points) -> Built:
    """Return the model that records what an observer of one body needs."""
    part, rows = built.particles.of(body), observer.rows
    n = built.particles.layout.n_particles
    wide = sparse.csr_array((rows.data, rows.indices + part.start, rows.indptr), shape=(rows.shape[0], n))
    return replace(built, model=replace(built.model, probe=wide))


# --- targets ----------------------------------------------------------------------------------------------------


def _targeted(built: Built) -> Case:
    scene = built.scene
    spec, model = scene.target, built.model
    assert spec is not None
    part = built.particles.of(spec.body)
    observer = centroid(np.ones(part.stop - part.start))  # a plain mean, as in all objectives: no value can change it
    objective = TargetObjective(
        observer, np.array(spec.position), time=spec.time, control_step=scene.time.control_step, steps=model.n_controls
    )
    return Case("target", _probed(built, spec.body, observer), (objective,))


# --- synthetic data -----------------------------------------------------------------------------------------------


def _synthetic(built: Built, directory: Path | None) -> list[Case]:
    scene = built.scene
    spec = scene.synthetic
    assert spec is not None
    rng = np.random.default_rng(spec.seed)
    part = built.particles.of(spec.body)
    if spec.markers is not None:
        names = tuple(spec.markers)
        observer = _observe_markers(built, spec.body, {k: np.array(v) for k, v in spec.markers.items()})
    else:
        count = part.stop - part.start
        chosen = np.sort(rng.choice(count, int(spec.tracked or 0), replace=False))
        names = tuple(f"particle {index}" for index in chosen)
        observer = particles(chosen, count)
    base = _probed(built, spec.body, observer)
    random = scene.activation is not None and scene.activation.random is not None
    cases = []
    for sequence in range(scene.sequences):
        name = f"sequence_{sequence}" if random else "synthetic"
        own = replace(base, assembly=base.assembly.with_sequence(sequence))
        recordings = _made(own, name, names, observer, rng, directory)
        objectives = tuple(_absolute(own.model, observer, recording) for recording in recordings)
        cases.append(Case(name, own, objectives))
    return cases


def _made(
    built: Built, name: str, names: tuple[str, ...], observer: Points, rng: np.random.Generator, directory: Path | None
) -> list[Recording]:
    """Return the noisy copies of one sequence: read from the run, or made and written there."""
    scene = built.scene
    spec = scene.synthetic
    assert spec is not None
    draw = np.random.default_rng(rng.integers(2**63))  # one generator a sequence, whatever is on disk already
    files = [(directory / SYNTHETIC / f"{name}_{copy}.csv") if directory else None for copy in range(spec.copies)]
    if all(file is not None and file.is_file() for file in files):
        return [read_recording(file) for file in files if file is not None]
    model = built.model
    truth = {path: np.asarray(value, float) for path, value in truths(scene).items()}
    record = Rollout(model, built.assembly.inputs(truth)).run()
    steps, step = model.n_controls, scene.time.control_step
    if spec.every is not None:
        time = np.unique([*range(0, steps, spec.every), steps]) * step
    else:
        time = np.linspace(0.0, steps * step, int(spec.key_frames or 0))
    clean = MarkerObjective(
        observer, names, time, np.zeros((len(time), len(names), model.dim)), control_step=step, steps=steps,
        start=0.0, absolute=True,
    ).tracks(record, 0.0)  # fmt: skip
    made = make_synthetic(time, names, clean, noise=spec.noise, copies=spec.copies, rng=draw, source=name)
    for recording, file in zip(made, files, strict=True):
        if file is not None:
            make_directory(file.parent)
            beginning = file.with_suffix(".part")
            with disk_errors(file):
                write_csv(recording, beginning)
                beginning.replace(file)  # a run that is killed here never reads half a file
    return made


def _absolute(model: Model, observer: Points, recording: Recording) -> MarkerObjective:
    """Return the errors of a recording whose positions are in the scene's frame, with the run's own clock."""
    return MarkerObjective(
        observer, recording.names, recording.time, recording.positions,
        control_step=model.dt * model.substeps, steps=model.n_controls, start=0.0, absolute=True,
        source=recording.source,
    )  # fmt: skip
