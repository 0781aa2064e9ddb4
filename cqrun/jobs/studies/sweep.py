"""`cqrun sweep`: run a scene at many points, several at once, and write what was asked and found into one table.

Every point is a run in its own process, which can be stopped and resumed like any other run. The same command continues
unfinished runs, and a wider sweep uses those that are finished. The sweep is written beside their directories:

sweep-<hash>.csv    one row per run: its values, how it ended, what it found, its directory
sweep-<hash>.json   the same
sweep-<hash>.png    a picture (figures/sweep.py)

The hash is that of the scene, the job and the points.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cqrun.errors import SceneError, UsageError
from cqrun.explain import listed, suggest
from cqrun.jobs.job import Job
from cqrun.jobs.studies.axes import Point, Sampling, axis_of, points_of
from cqrun.jobs.studies.members import INFEASIBLE, Executor, command_of, has_ended
from cqrun.jobs.studies.quantities import Quantity, measured_in, quantities_of
from cqrun.jobs.table import JOBS
from cqrun.running.cluster import PROCESSES
from cqrun.running.fleet import Member
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import Source, is_run, run_scene, scene_in
from cqrun.running.tables import number, table
from cqrun.running.threads import cores
from cqrun.scene.keypath import shortest
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaf
from cqrun.scene.plugin_files import plugins_allowed
from cqrun.scene.schema import Scene
from cqrun.store.atomic import write_table
from cqrun.store.folder import make_below
from cqrun.store.model_file import path_of
from cqrun.store.places import results_in
from cqrun.store.result import LearnedResult, SimulateResult, read_result
from cqrun.store.run import read_record
from cqrun.store.run_scene import RunScene
from cqrun.store.study import Found, Sweep, SweptRun, read_sweep, write_study

MOST_ROWS = 40
"""Rows of the table at the terminal, at most; the file has all."""

MOST_COLUMNS = 4
"""Numbers that the table at the terminal shows of each run, at most."""


@dataclass(frozen=True)
class SweepOptions:
    """What a sweep runs.

    Attributes:
        axes: texts after `-s`.
        samples: number of samples of the ranges without a count.
        sampling: how they are drawn, and `draw` the seed for it.
        seeds: the scene's `seed` takes the values 0 .. seeds - 1, too.
        job: name of the job; the scene's own if None, or simulate if it has none.
        jobs: number of processes at once; the number of threads if None.
        on: where they run: `processes` of this machine, or a place of running/cluster.py.
    """

    axes: Sequence[str] = ()
    samples: int | None = None
    sampling: Sampling = "latin"
    draw: int = 0
    seeds: int | None = None
    job: str | None = None
    jobs: int | None = None
    on: str = PROCESSES

    def points(self) -> list[Point]:
        """Return the points; raise UsageError as `points_of`."""
        for name, count in (("seeds", self.seeds), ("jobs", self.jobs), ("samples", self.samples)):
            if count is not None and count < 1:
                raise UsageError(f"--{name} {count}: must be at least 1")
        texts = [*self.axes, *([f"seed={','.join(map(str, range(self.seeds)))}"] if self.seeds else [])]
        return points_of([axis_of(text) for text in texts], self.samples, self.sampling, self.draw)


def run_sweep(
    source: Path | str, overrides: Sequence[str], out: Path | str, options: SweepOptions, *, fresh: bool = False,
    threads: int | None = None, allow_plugins: bool = False, reporter: Reporter | None = None,
) -> tuple[Path, bool]:  # fmt: skip
    """Run a scene at all points of a sweep; return the sweep's JSON file, and whether all runs succeeded.

    Args:
        source: the scene file, or a run.
        threads: number of threads for all processes, which share them equally.
        allow_plugins: passed to the processes.

    Raises:
        SceneError, UsageError: bad input. Stopped: asked to stop; the same command continues.
    """
    source, out, talk = Path(source), Path(out), reporter or Silent()
    points, n_threads = options.points(), cores(threads)
    job = _job_of(options.job, source, overrides)
    given = job.read(source, overrides, Silent())
    at_once = min(len(points), options.jobs or n_threads)
    executor = Executor(source, out, given.scene, job, at_once, options.on)
    words = command_of(job.name, source, out, n_threads // at_once, fresh, allow_plugins)
    names = list(dict.fromkeys(path for point in points for path in point))
    members = list(_members(points, names, words, job, source, overrides, out, talk))
    path = make_below(out, given.stem) / f"sweep-{_digest(given, job, points)}.json"
    executor.run(members, "runs", f"{len(members)} runs of {job.name}, {at_once} at once", talk)
    good = sum(member.failure is None for member in members)
    units = _units(job.read(source, _overrides(overrides, points[0]), Silent()).scene, names)
    sweep = _summary(given.stem, job, points, units, members)
    write_study(path, sweep)
    write_table(path.with_suffix(".csv"), table_rows(sweep))
    if talk.stop.asked and good < len(points):
        raise talk.stop.stopped(f"{good} of {len(points)} runs are finished; the same command continues the others")
    return path, good == len(points)


def sweep(
    scene: Path | str, axes: Sequence[str], overrides: Sequence[str] = (), *, samples: int | None = None,
    seeds: int | None = None, job: str | None = None, jobs: int | None = None, on: str = PROCESSES,
    out: Path | str | None = None, fresh: bool = False, threads: int | None = None, allow_plugins: bool = False,
) -> Sweep:  # fmt: skip
    """Run a scene file at many points, each in a process of its own.

    Args:
        scene: the scene file, or a run, whose scene is run with its own job; a run that learned or identified something
            is replayed with `job="simulate"`.
        axes: texts such as `key=1,2,3`, `key=1:5:9`, `key=1e4:1e6:log:7` or, with `samples`, `key=1:5`.
        overrides: list of `key.path=value`, the same for all points.
        samples: number of points of a Latin hypercube in the ranges without a count.
        seeds: the scene's seed takes the values 0 .. seeds - 1, too.
        job: sysid, control, codesign, simulate or rest; the scene's own if not given, or simulate if it has none.
        jobs: number of runs at once; the number of threads if not given.
        on: `processes`, `dask`, `dask://HOST:PORT` or `slurm`.
        out: directory of all results, in which finished runs are not repeated; `results` beside the scene if not given.
        fresh: delete existing runs and start again.
        threads: number of threads of all runs together; all cores if not given.
        allow_plugins: whether to run the plug-in files that the scene names.

    Returns:
        `runs`, each with its `values`, `status`, `found` numbers and `run` directory.

    Raises:
        SceneError, UsageError: bad input.
    """
    options = SweepOptions(axes, samples, seeds=seeds, job=job, jobs=jobs, on=on)
    with plugins_allowed(allow_plugins):
        path, _ = run_sweep(
            scene, overrides, results_in(out, Path(scene)), options, fresh=fresh, threads=threads,
            allow_plugins=allow_plugins,
        )  # fmt: skip
    return read_sweep(path)


def _job_of(name: str | None, source: Path, overrides: Sequence[str]) -> Job[Any, Any]:
    """Return the job of a sweep: the one that is named, that of a run, or the scene's own."""
    own = read_record(source)["job"] if is_run(source) else load_scene(source, overrides).job
    chosen = name or own or "simulate"
    if chosen not in JOBS or chosen == "gradcheck":
        known = [job for job in JOBS if job != "gradcheck"]
        raise UsageError(f"--job {chosen}: there is no such job; there are {listed(known)}")
    return JOBS[chosen]


def _members(
    points: Sequence[Point], names: Sequence[str], words: Sequence[str], job: Job[Any, Any], source: Path,
    overrides: Sequence[str], out: Path, talk: Reporter,
) -> Iterator[Member]:  # fmt: skip
    """Yield the run of every point, after the scene of this point is checked.

    Raises:
        SceneError: the scene of a point is wrong.
    """
    labels, warned = dict(zip(names, shortest(names), strict=True)), set[str]()
    for k, point in enumerate(points, start=1):
        talk.phase(f"checking point {k} of {len(points)}")
        label = ", ".join(f"{labels[path]}={value}" for path, value in point.items())
        own = _overrides(overrides, point)
        try:
            given = job.read(source, own, Silent())
            scene = job.prepare(given.scene, 1, Silent(), given.files).built
        except SceneError as error:
            raise SceneError([replace(p, message=f"at {label}: {p.message}") for p in error.problems]) from None
        for warning in map(str, scene.warnings):
            if warning not in warned:
                talk.warn(warning if len(points) == 1 else f"{warning} (first at {label})")
            warned.add(warning)
        optimizer: Any = None if scene.scene.optimizer is None else scene.scene.optimizer.value
        digest = _inputs(given, scene.scene, job).digest()
        options = [word for override in own for word in ("-o", override)]
        steps = getattr(optimizer, "max_iterations", 1) if job.extensible else 1
        yield Member(label, out / given.stem / digest, [*words, *options], steps)


def _inputs(given: Source, scene: Scene, job: Job[Any, Any]) -> RunScene:
    """Return the inputs of a run of what is given, with its scene as a job has prepared it."""
    return run_scene(given.stem, scene, job=job.name, with_data=job.reads_data(scene), files=given.files)


def _overrides(overrides: Sequence[str], point: Point) -> list[str]:
    return [*overrides, *(f"{path}={value}" for path, value in point.items())]


def _digest(given: Source, job: Job[Any, Any], points: Sequence[Point]) -> str:
    """Return the hash of what is given, the job and the points."""
    digest = _inputs(given, given.scene, job).digest()
    return hashlib.sha256(f"{digest}\0{[*points]}".encode()).hexdigest()[:12]


# --- what was found ---------------------------------------------------------------------------------------------------


def _summary(
    stem: str, job: Job[Any, Any], points: Sequence[Point], axes: Mapping[str, str | None], members: Sequence[Member]
) -> Sweep:
    """Return the runs of all points with what they found; `axes` has the unit of each axis, None if it is no number."""
    runs, units = [], dict[str, str]()
    for point, member in zip(points, members, strict=True):
        quantities = found_in(job, member.run) if has_ended(member) else {}
        units |= {name: quantity.unit for name, quantity in quantities.items()}
        record = read_record(member.run) if has_ended(member) else {"status": "failed"}
        runs.append(SweptRun(
            values=point, run=str(member.run), status=str(record["status"]), reason=member.failure,
            found={name: quantity.value for name, quantity in quantities.items()},
        ))  # fmt: skip
    found = {name: Found(unit=unit) for name, unit in units.items()}
    given = {path: unit for path, unit in axes.items() if unit is not None}
    return Sweep(scene=stem, job=job.name, axes=list(axes), units=given, found=found, runs=runs)


def _units(scene: Scene, paths: Sequence[str]) -> dict[str, str | None]:
    """Return the unit of the number at each key path: empty for a pure number, None if there is no number."""
    units: dict[str, str | None] = {}
    for path in paths:
        try:
            unit = leaf(scene, path).unit
            units[path] = "" if unit == "1" else unit
        except SceneError:
            units[path] = None
    return units


def found_in(job: Job[Any, Any], run: Path) -> dict[str, Quantity]:
    """Return the numbers that a finished run found, by name: its loss first."""
    result = read_result(run)
    scores: dict[str, float] = {}
    if isinstance(result, LearnedResult):
        stages = result.stages()
        stage = stages.get("trained") or stages.get("start")
        scores = {} if stage is None else {"loss": stage.loss, **stage.terms}
        scores |= {name: float(u.value) for name, u in result.unknowns.items() if isinstance(u.value, float | int)}
        return {name: Quantity(value, "") for name, value in scores.items()} | measured_in(run)
    if isinstance(result, SimulateResult) and result.loss is not None:
        scores = {"loss": result.loss, **(result.terms or {})}
    built = job.prepare(scene_in(run), 1, Silent()).built
    return {name: Quantity(value, "") for name, value in scores.items()} | quantities_of(job.name, run, built)


def table_rows(sweep: Sweep) -> Iterator[list[object]]:
    """Yield the rows of sweep.csv."""
    yield [*sweep.axes, "status", *(_titled(name, of.unit) for name, of in sweep.found.items()), "run", "reason"]
    for run in sweep.runs:
        values = [run.values[path] for path in sweep.axes]
        yield [*values, run.status, *(run.found.get(name) for name in sweep.found), run.run, run.reason]


def _titled(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


# --- the report -------------------------------------------------------------------------------------------------------


def sweep_lines(path: Path, show: Sequence[str] = ()) -> list[str]:
    """Return a sweep as lines for a terminal.

    Args:
        show: names of the numbers in the table; if no run found any, at most `MOST_COLUMNS` of those that differ.
    """
    sweep = read_sweep(path)
    failed = [run for run in sweep.runs if run.status == "failed"]
    columns = [name for name in show if name in sweep.found] or sweep.varying()[:MOST_COLUMNS]
    titles = sweep.titles()
    head = (*(_titled(titles[name], sweep.unit(name)) for name in (*sweep.axes, *columns)), "status")
    rows = [
        (*(run.values[path] for path in sweep.axes), *(_cell(run.found.get(name)) for name in columns), run.status)
        for run in sweep.runs[:MOST_ROWS]
    ]
    lines = [f"{len(sweep.runs) - len(failed)} of {len(sweep.runs)} runs ended", "", *table(head, rows)]
    if len(sweep.runs) > MOST_ROWS:
        lines.append(f"... and {len(sweep.runs) - MOST_ROWS} more in {path.with_suffix('.csv')}")
    infeasible = sum(run.status == INFEASIBLE for run in sweep.runs)
    lines += [f"{infeasible} runs do not meet their constraints"] if infeasible else []
    lines += [f"failed: {path_of(run.run)}: {run.reason}" for run in failed]
    picture = path.with_suffix(".png")
    lines += ["", f"picture: {picture}"] if picture.is_file() else [""]
    return [*lines, f"sweep: {path.with_suffix('.csv')}"]


def numbers_shown(sweep: Sweep, names: Sequence[str]) -> list[str]:
    """Return the names of numbers that runs found; that of a measured quantity stands for its value at the end.

    Raises:
        UsageError: no run found a number of a name.
    """
    ends = {name.removesuffix(".end"): name for name in sweep.found if name.endswith(".end")}
    found = [name if name in sweep.found else ends.get(name, "") for name in names]
    if "" in found:
        unknown = names[found.index("")]
        near = suggest(unknown, sweep.found)
        raise UsageError(f"--show {unknown}: no run found it{near}; there are {listed(sweep.found)}")
    return found


def _cell(value: float | None) -> str:
    return "-" if value is None else number(value)
