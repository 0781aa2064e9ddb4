"""`cqrun sysid`: identify a scene's unknowns from data, with intervals.

If all recordings are held out, nothing is fitted: the job predicts them with the scene's own values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from cqrun.build.model import Built
from cqrun.errors import Problem, SceneError
from cqrun.fitting.case import Case
from cqrun.fitting.cases import given_cases, made_cases, recording_warnings, remarks
from cqrun.fitting.findings import write_findings
from cqrun.fitting.predictions import write_prediction_alone
from cqrun.fitting.problem import FitProblem
from cqrun.fitting.runners import how_long
from cqrun.fitting.stiffness import LONG, ONCE
from cqrun.jobs.job import NO_FILES, Job, Need
from cqrun.optimizers.base import Outcome
from cqrun.running.bodies import report_bodies, resolved_lines
from cqrun.running.cost import about
from cqrun.running.gradient_memory import gradient_plan
from cqrun.running.kernels import compile_kernels
from cqrun.running.measuring import measured_lines
from cqrun.running.reporter import Reporter
from cqrun.running.runs import Progress, build_and_warn, kept_scene, optimizer_of
from cqrun.running.tables import number, table
from cqrun.running.unknowns import make_params
from cqrun.scene.paths import leaf
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import groups_of
from cqrun.store.result import Identified, Interval, SysidResult
from cqrun.store.run import RunDirectory, read_record
from cqrun.store.session import RunSession

MANY = 8
"""If a block has more numbers, only their range is printed."""

MOST_POSES = 24
"""If a recording has more poses, their errors are only in result.json."""

FEW = 10
"""Largest number of unknowns for which least squares is the default optimizer."""


@dataclass(frozen=True)
class Identification:
    """A fit that is ready to run; `cases` is None if its synthetic data are not made yet."""

    built: Built
    cases: list[Case] | None
    threads: int


@dataclass(frozen=True)
class Sysid(Job[Identification, SysidResult]):
    """Find a scene's unknowns from data."""

    def prepare(
        self, scene: Scene, threads: int, talk: Reporter, files: Mapping[str, Path] = NO_FILES
    ) -> Identification:
        """Build a scene with its optimizer, and read its data.

        Raises:
            SceneError: there are no unknowns, or neither data nor objective, or too little memory for gradients.
        """
        if scene.predicts_only:
            _refuse_parts(scene)
            built = build_and_warn(scene, talk)
            return Identification(built, given_cases(built), threads)
        self.require_sections(scene)
        _refuse_parts(scene)
        scene = with_optimizer(scene)
        if scene.data is None and optimizer_of(scene).squares:
            path = f"optimizer.{optimizer_of(scene).name}"
            message = "fits data by least squares; for an objective take lbfgs, adam, sgd or cma_es"
            raise SceneError([Problem(scene.where(path), path, message)])
        if scene.precision == "float32" and not uses_gradients(scene) and optimizer_of(scene).squares:
            path = f"optimizer.{optimizer_of(scene).name}"
            message = "`precision: float32` is too coarse for its finite differences: use lbfgs, or float64"
            raise SceneError([Problem(scene.where(path), path, message)])
        built = build_and_warn(scene, talk)
        if uses_gradients(built.scene):
            gradient_plan(built)
        _require_batches(built.scene)
        return Identification(built, given_cases(built), threads)

    def reads_data(self, scene: Scene) -> bool:
        """Return True: it fits recordings."""
        return True

    def work(self, run: RunDirectory, prepared: Identification, talk: Reporter) -> None:
        """Run or continue the identification, or predict if there is nothing to fit."""
        if prepared.built.scene.predicts_only:
            _predict(run, prepared, talk)
            return
        built, cases = prepared.built, prepared.cases
        scene, optimizer = built.scene, optimizer_of(built.scene)
        _compile(built, cases, talk, adjoint=uses_gradients(scene))
        run.begin(prepared.threads)
        report_bodies(built, run, talk)
        if cases is None:
            talk.phase(f"making data, {about(built.model)}")
            cases = made_cases(run, built, talk.stop.check)
        _report_recordings(run, built, cases, talk)
        params = make_params(built)
        problem = FitProblem(cases, params, threads=prepared.threads, interrupt=talk.stop.check)
        lasts = how_long([case.runner for case in problem.cases], gradients=uses_gradients(scene))
        talk.phase(f"fitting {len(params.start)} unknowns, {lasts}")
        talk.begin(optimizer.max_iterations)
        session = RunSession(
            run, seed=scene.seed, blocks=params.slices, physical=params.physical, loss_unit=problem.unit,
            stop=lambda: talk.stop.asked, progress=Progress(run, talk),
        )  # fmt: skip
        _conclude(run, cases, problem, optimizer.minimise(problem, session), talk)

    def lines(self, run: Path, result: SysidResult) -> Iterator[str]:
        """Yield every unknown with its interval, the errors by recording, and the findings."""
        scene = kept_scene(run, read_record(run))
        predicts = scene.predicts_only
        after = "" if predicts else f" after {result.iterations} iterations"
        yield f"{result.status}{after}: {result.message}"
        yield ""
        if result.unknowns:
            yield from table(
                ("unknown", "value", "95 % interval", "unit", "from"),
                [row for path, unknown in result.unknowns.items() for row in _unknown(scene, path, unknown)],
            )
        yield from _moduli(result)
        reasons = {path: unknown.reason for path, unknown in result.unknowns.items() if unknown.reason}
        if reasons:
            yield ""
            if len(reasons) == len(result.unknowns) and len(set(reasons.values())) == 1:
                yield f"no intervals: {next(iter(reasons.values()))}"
            else:
                yield from (f"no interval for {path}: {reason}" for path, reason in reasons.items())
        if result.substeps is not None:
            yield from [f"predicted with time.substeps={result.substeps}"] if predicts else result.how_found()
        if scene.data is not None and scene.synthetic is None and any(u.interval for u in result.unknowns.values()):
            yield "an interval covers the noise of the data alone; `--resolution` finds what the grid adds"
        yield from _held(result)
        yield ""
        yield from _errors(scene, result)
        yield from measured_lines(result.measured)
        yield from resolved_lines(result.thinnest)
        yield from (f"note: {sentence}" for sentence in result.findings)


SYSID = Sysid(
    "sysid",
    SysidResult,
    needs=(
        Need(
            "unknowns",
            "give the key paths of the numbers to identify, with bounds; to predict only, mark every recording "
            "`holdout: true`",
        ),
        Need("data", "say what it is fitted to, or give an `objective` to minimise", instead="objective"),
    ),
    pictures=("convergence", "tracks", "bodies", "measured", "overview"),
    extensible=True,
)
run_sysid = SYSID.run


# --- before the fit ---------------------------------------------------------------------------------------------------


def _refuse_parts(scene: Scene) -> None:
    """Raise SceneError for parts of a scene that a fit does not support."""
    if scene.controller is not None:
        message = (
            "sysid drives actuators by `activation` only, not by a controller: remove it, `-o controller=null`, and "
            "give its output as signals (a run's activation.csv has it)"
        )
        raise SceneError([Problem(scene.where("controller"), "controller", message)])
    for name in (name for name, unknown in scene.unknowns.items() if unknown.regulariser):
        path = f"unknowns.{name}.regulariser"
        message = "sysid takes none: it would pull the value towards the start, which intervals do not show"
        raise SceneError([Problem(scene.where(path), path, message)])
    for name in scene.constraints:
        path, message = f"constraints.{name}", "sysid does not support constraints: bound its unknowns instead"
        raise SceneError([Problem(scene.where(path), path, message)])


def _require_batches(scene: Scene) -> None:
    """Raise SceneError if mini-batches are larger than the data."""
    size = None if scene.optimizer is None else getattr(scene.optimizer.value, "batch_size", None)
    sequences = scene.sequences if scene.synthetic is not None else 1
    parts = sum(not spec.holdout for spec in scene.recordings.values()) or sequences
    if size is not None and size > parts:
        assert scene.optimizer is not None
        path = f"optimizer.{scene.optimizer.name}.batch_size"
        message = f"is {size}, but the data have {parts} parts (recordings, sequences): give at most {parts}"
        raise SceneError([Problem(scene.where(path), path, message)])


def uses_gradients(scene: Scene) -> bool:
    """Return whether a scene's optimizer uses gradients; least squares uses differences."""
    return scene.optimizer is None or optimizer_of(scene).gradients


def with_optimizer(scene: Scene) -> Scene:
    """Return the scene with its optimizer, or with the default one."""
    if scene.optimizer is not None:
        return scene
    from cqrun.plugin.registry import plugins

    suited = scene.data is not None and _numbers(scene) <= FEW and scene.precision == "float64"
    name = "least_squares" if suited else "lbfgs"
    return scene.with_plugin("optimizer", plugins("optimizer")[name]())


def _numbers(scene: Scene) -> float:
    """Return the number of unknown numbers; infinity if an unknown has one per particle or is a field."""
    count = 0.0
    for path, unknown in scene.unknowns.items():
        count += {"body": 1, "group": len(groups_of(scene, path))}.get(unknown.per, float("inf"))
    return count


# --- after it ---------------------------------------------------------------------------------------------------------


def _predict(run: RunDirectory, prepared: Identification, talk: Reporter) -> None:
    """Predict the recordings of a scene in which all are held out, and end the run."""
    built, cases, threads = prepared.built, prepared.cases or [], prepared.threads
    _compile(built, cases, talk, adjoint=False)
    run.begin(threads)
    report_bodies(built, run, talk)
    _report_recordings(run, built, cases, talk)
    number_of = f"{len(cases)} recording{'s' * (len(cases) > 1)}"
    lasts = how_long([case.runner for case in cases])
    talk.phase(f"every recording is held out: predicting {number_of}, fitting nothing, {lasts}")
    result = write_prediction_alone(run, cases, make_params(built), threads, talk.stop.check)
    run.finish(result.status, result.message)


def _compile(built: Built, cases: list[Case] | None, talk: Reporter, *, adjoint: bool) -> None:
    """Compile the kernels of all motions; bodies at rest need others, which their first equilibrium compiles."""
    moving = [built] if cases is None else [case.built for case in cases if not case.points]
    compile_kernels(moving, talk, adjoint=adjoint)


def _report_recordings(run: RunDirectory, built: Built, cases: list[Case], talk: Reporter) -> None:
    """Report what looks wrong in recordings, and log how they were read."""
    for warning in recording_warnings(built, cases):
        talk.warn(warning)
    for sentence in remarks(cases):
        run.log(sentence)


def _conclude(run: RunDirectory, cases: list[Case], problem: FitProblem, outcome: Outcome, talk: Reporter) -> None:
    """Write the results, and end the run with the status of the outcome."""
    if outcome.status == "stopped":
        write_findings(run, cases, problem, outcome)
        run.finish("stopped", talk.stop.named(outcome.message))
        raise talk.stop.stopped(f"{outcome.message}; `cqrun resume {run.path}` continues")
    if outcome.status != "failed":
        talk.phase(f"intervals, predictions, trajectory, {how_long([case.runner for case in cases])}")
    write_findings(run, cases, problem, outcome)
    run.finish(outcome.status, outcome.message)


def _unknown(scene: Scene, path: str, unknown: Identified) -> Iterator[tuple[str, ...]]:
    unit = leaf(scene, path).unit
    values, intervals, initials = unknown.numbers()
    if len(values) > MANY:
        ends = f"{number(min(values))} ... {number(max(values))}"
        yield path, ends, f"{len(values)} numbers", unit, number(initials[0])
        return
    for k, (value, interval, initial) in enumerate(zip(values, intervals, initials, strict=True)):
        yield unknown.names(path)[k], number(value), _interval(interval), unit, number(initial)


def _moduli(result: SysidResult) -> Iterator[str]:
    """Yield Young's moduli that follow from the unknowns."""
    rows = []
    for body, moduli in result.moduli.items():
        names = {LONG: "after a long time", ONCE: "against a sudden change"} if ONCE in moduli else {LONG: ""}
        rows += [
            (f"E of '{body}' {name}".rstrip(), number(moduli[kind].value), _interval(moduli[kind].interval), "Pa")
            for kind, name in names.items()
            if kind in moduli
        ]
    if rows:
        yield ""
        yield from table(("Young's modulus at small strains", "value", "95 % interval", "unit"), rows)


def _interval(pair: Interval | None) -> str:
    return "none" if pair is None else f"{number(pair[0])} to {number(pair[1])}"


def _held(result: SysidResult) -> Iterator[str]:
    """Yield what the intervals hold fixed, and what the fit would find with another value."""
    intervals: dict[str, Interval | None] = {}
    for path, unknown in result.unknowns.items():
        intervals |= dict(zip(unknown.names(path), unknown.numbers()[1], strict=True))
    rows: list[tuple[str, ...]] = []
    for path, held in result.held.items():
        shown = []
        for name, value in held.found.items():
            low, high = intervals[name] or (value, value)
            if not low <= value <= high or len(held.found) <= MANY:
                shown.append((name, number(value), "inside" if low <= value <= high else "outside its interval"))
        shown = shown or [("all of them", "", "inside their intervals")]
        heads = [(path, number(held.value), number(held.other)), *[("", "", "")] * (len(shown) - 1)]
        rows += [(*head, *cells) for head, cells in zip(heads, shown, strict=True) if held.found]
    if rows:
        yield ""
        yield "The intervals hold these numbers fixed. With the value under `if`, the fit would find about:"
        yield from table(("held fixed", "is", "if", "unknown", "would be", ""), rows)


def _of_poses(result: SysidResult) -> Iterator[str]:
    """Yield the mean distance of markers in all poses, and in each."""
    for name, error in (result.recordings or {}).items():
        mean, each = error.number("mean_mm"), error.numbers("poses_mm")
        if mean is not None:
            poses = ", ".join(f"{pose} {'unseen' if e is None else format(e, '.2f')}" for pose, e in each.items())
            by_pose = f"; by pose: {poses}" if len(each) <= MOST_POSES else ""
            yield f"{name}: mean marker error {mean:.3f} mm{by_pose}"


def _errors(scene: Scene, result: SysidResult) -> Iterator[str]:
    if result.recordings is None:
        if result.loss is not None:
            yield f"loss {result.loss:.6g} {scene.loss_unit}".rstrip()
        return
    assert scene.data is not None
    tables: dict[str, list[tuple[str, ...]]] = {}
    heads: dict[str, tuple[str, ...]] = {}
    for name, error in result.recordings.items():
        measured = scene.data.measurement(name)
        unit = f" [{measured.shown.name}]" if measured.shown.name else ""
        heads[measured.name] = ("recording", "", f"RMSE{unit}", f"by {measured.channel}{unit}")
        rmse, each = error.number(measured.error_key("rmse")), error.numbers(measured.error_key(f"{measured.channel}s"))
        cells = [f"{key} {'unseen' if e is None else format(e, measured.digits)}" for key, e in each.items()]
        kind = "held out" if error.holdout else "fitted"
        row = (name, kind, "blew up" if rmse is None else format(rmse, measured.digits))
        tables.setdefault(measured.name, []).append((*row, ", ".join(cells) if len(cells) <= 12 else ""))
    for kind, rows in tables.items():
        yield from table(heads[kind], rows)
    made = scene.synthetic
    if made is not None and made.noise > 0:
        sigma, alone = (format(1e3 * noise, ".3g") for noise in (made.noise, made.noise * scene.dim**0.5))
        yield f"RMSEs are of distances: the noise of {sigma} mm in each coordinate alone gives {alone} mm"
    yield from _of_poses(result)
    for name, error in result.recordings.items():
        if away := [e for e in error.numbers("alignment_mm").values() if e is not None]:
            yield f"{name}: aligned to the rest positions within {min(away):.2f} to {max(away):.2f} mm"
