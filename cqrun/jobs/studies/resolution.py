"""`--resolution`: run a scene on two or three grids, and extrapolate what it finds to a cell size of zero.

Every grid is a run of its own, which can be stopped and resumed like any other; the same command continues unfinished
runs. The study is written beside their directories:

resolution-<hash>.json   the runs; each quantity on each grid, extrapolated, with its stated error and order; notes
resolution-<hash>.csv    the quantities as a table

The hash is that of the scene and the grids. grids.py makes the scene of each grid, quantities.py says what is compared,
and extrapolation.py has the arithmetic.
"""

from __future__ import annotations

import hashlib
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cqrun.build.model import Built
from cqrun.build.thickness import thinnest_parts
from cqrun.errors import Problem, SceneError, Stopped, UsageError
from cqrun.explain import listed
from cqrun.jobs.job import Job
from cqrun.jobs.studies.extrapolation import HIGHEST, LOWEST, SAFETY, extrapolate
from cqrun.jobs.studies.grids import AUTO, changes, differences, grid_overrides, grids_of, require_cells
from cqrun.jobs.studies.quantities import Quantity, quantities_of
from cqrun.jobs.table import JOBS
from cqrun.running.bodies import resolved
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.runs import run_scene
from cqrun.running.tables import number, table
from cqrun.scene.load import load_scene
from cqrun.scene.plugin_files import plugins_allowed
from cqrun.scene.schema import Scene
from cqrun.store.atomic import write_table
from cqrun.store.folder import make_below
from cqrun.store.model_file import path_of
from cqrun.store.places import results_in
from cqrun.store.run import read_record
from cqrun.store.run_scene import stem_of
from cqrun.store.study import GridRun, OnGrids, Resolution, read_resolution, write_study
from cqrun.store.thinnest import Thinnest

COMPARED = ("sysid", "rest", "simulate")
"""Jobs whose results can be compared between grids."""

ROUNDING = 1e-7
"""Changes below this part of the largest quantity of the same unit are rounding."""

TWIN = (
    "the data are synthetic, and each grid makes its own, so the values show the fit and not the error of the grid; "
    "use recordings for that"
)


@dataclass(frozen=True)
class _Grid:
    """A grid of the study: its cells [m], what is changed in the scene for it, the scene built on it, its warnings."""

    dx: float
    overrides: list[str]
    built: Built
    thinnest: dict[str, Thinnest]
    warnings: tuple[str, ...]


class _Collecting(Silent):
    """A reporter that keeps warnings, each once."""

    def __init__(self) -> None:
        super().__init__()
        self.warnings: dict[str, None] = {}

    def warn(self, text: str) -> None:
        self.warnings[text] = None


class _Untold:
    """Passes all reports on, except warnings that were given before."""

    def __init__(self, talk: Reporter, told: Container[str]) -> None:
        self._talk, self._told = talk, told

    def __getattr__(self, name: str) -> Any:
        return getattr(self._talk, name)

    def warn(self, text: str) -> None:
        if text not in self._told:
            self._talk.warn(text)


def run_resolution(
    source: Path | str, overrides: Sequence[str], out: Path | str, *, job: Job[Any, Any], grids: str,
    fresh: bool = False, threads: int | None = None, reporter: Reporter | None = None,
) -> tuple[Path, bool]:  # fmt: skip
    """Run a scene on several grids, one after the other; return the file of the study, and whether all succeeded.

    Args:
        job: sysid, rest or simulate.
        grids: cell sizes with commas, finest last; or `auto`, which is the scene's, and one 1.5 times smaller.

    Raises:
        SceneError, UsageError: bad input. Stopped: asked to stop; the same command continues.
    """
    source, out, talk = Path(source), Path(out), reporter or Silent()
    if source.is_dir():
        raise UsageError(f"{source}: --resolution runs a scene on several grids: give the scene file, not a run")
    scene = load_scene(source, overrides)
    plan = _plan(source, overrides, scene, grids_of(grids, scene), job)
    notes = list(_notes(scene, plan, job, talk))
    _warn(plan, talk)
    untold: Any = _Untold(talk, {warning for grid in plan for warning in grid.warnings})
    folder = make_below(out, stem_of(source))
    runs: list[GridRun] = []
    found: list[dict[str, Quantity] | None] = []
    for k, grid in enumerate(plan):
        talk.phase(f"grid {k + 1} of {len(plan)}: cells of {number(grid.dx)} m")
        try:
            run = job.start(
                stem_of(source), load_scene(source, [*overrides, *grid.overrides]), out, fresh=fresh, threads=threads,
                reporter=untold,
            )  # fmt: skip
        except Stopped as stopped:
            done = f"{k} of {len(plan)} grids are finished; the same command continues"
            raise talk.stop.stopped(f"{done} ({stopped})") from None
        record = read_record(run)
        failed = record["status"] == "failed"
        runs.append(GridRun(
            dx=grid.dx, run=str(run), status=record["status"], reason=record.get("reason") if failed else None,
            overrides=grid.overrides, thinnest=grid.thinnest,
        ))  # fmt: skip
        found.append(None if failed else quantities_of(job.name, run, grid.built))
    study = Resolution(
        scene=stem_of(source), job=job.name, grids=runs, quantities=compared([grid.dx for grid in plan], found),
        notes=notes,
    )  # fmt: skip
    path = folder / f"resolution-{_name(source, scene, job, [grid.dx for grid in plan])}.json"
    write_study(path, study)
    write_table(path.with_suffix(".csv"), _table(study))
    return path, all(run.status != "failed" for run in runs)


def resolution(
    scene: Path | str, overrides: Sequence[str] = (), grids: Sequence[float] = (), *, job: str | None = None,
    out: Path | str | None = None, fresh: bool = False, threads: int | None = None, allow_plugins: bool = False,
) -> Resolution:  # fmt: skip
    """Run a scene file on two or three grids, and extrapolate what it finds to a cell size of zero.

    Args:
        scene: the scene file.
        overrides: list of `key.path=value`.
        grids: cell sizes, finest last [m]; the scene's, and one 1.5 times smaller, if not given.
        job: sysid, rest or simulate; the scene's own if not given, or simulate if it has none.
        out: directory of all results, in which finished runs are not repeated; `results` beside the scene if not given.
        fresh: delete existing runs and start again.
        threads: largest number of threads; all cores if not given.
        allow_plugins: whether to run the plug-in files that the scene names.

    Returns:
        The runs and `quantities`: by name, `values` on the grids, the extrapolated `value` and its `error`.

    Raises:
        SceneError, UsageError: bad input.
    """
    text = ",".join(repr(float(dx)) for dx in grids) or AUTO
    with plugins_allowed(allow_plugins):
        name = job or load_scene(scene, overrides).job or "simulate"
        if name not in COMPARED:
            raise UsageError(f"resolution: compares the grids of {listed(COMPARED)}, not of {name}")
        path, _ = run_resolution(
            scene, overrides, results_in(out, Path(scene)), job=JOBS[name], grids=text, fresh=fresh, threads=threads
        )  # fmt: skip
    return read_resolution(path)


def _plan(
    source: Path, overrides: Sequence[str], scene: Scene, cells: Sequence[float], job: Job[Any, Any]
) -> list[_Grid]:
    """Return all grids; whatever does not suit one of them is reported before the first run.

    Raises:
        SceneError: with the problems of all grids. UsageError: as `_grid`.
    """
    plan, problems = list[_Grid](), list[Problem]()
    for dx in cells:
        try:
            plan.append(_grid(source, overrides, scene, dx, job))
        except SceneError as error:
            problems += error.problems
    if problems:
        raise SceneError(problems)
    return plan


def _warn(plan: Sequence[_Grid], talk: Reporter) -> None:
    """Give the warnings of all grids, with the cells that each is about unless these are all."""
    for warning in dict.fromkeys(warning for grid in plan for warning in grid.warnings):
        cells = [number(grid.dx) for grid in plan if warning in grid.warnings]
        talk.warn(warning if len(cells) == len(plan) else f"{warning} (with cells of {listed(cells)} m)")


def _grid(source: Path, overrides: Sequence[str], scene: Scene, dx: float, job: Job[Any, Any]) -> _Grid:
    """Return a grid with the scene built on it.

    Raises:
        SceneError, UsageError: the scene cannot be run on this grid.
    """
    own, heard = grid_overrides(scene, dx), _Collecting()
    try:
        built = job.prepare(load_scene(source, [*overrides, *own]), 1, heard).built
    except SceneError as error:
        begin = f"with cells of {number(dx)} m: "
        raise SceneError([replace(p, message=begin + p.message) for p in error.problems]) from None
    thinnest = thinnest_parts(built)
    require_cells(dx, thinnest)
    return _Grid(dx, own, built, thinnest, tuple(heard.warnings))


def _notes(scene: Scene, plan: Sequence[_Grid], job: Job[Any, Any], talk: Reporter) -> Iterator[str]:
    """Report and yield what is changed with the grid, and what differs between the grids for other reasons."""
    for grid in plan:
        for name, part in grid.thinnest.items():
            talk.say(f"cells of {number(grid.dx)} m: {name} has {resolved(part)}")
        for sentence in changes(scene, grid.dx, grid.overrides):
            talk.say(sentence)
            yield sentence
    others = [*differences([grid.built for grid in plan]), *([TWIN] if job.name == "sysid" and scene.synthetic else [])]
    for sentence in others:
        talk.warn(sentence)
        yield sentence


def _name(source: Path, scene: Scene, job: Job[Any, Any], cells: Sequence[float]) -> str:
    """Return the hash of the scene and the grids."""
    digest = run_scene(stem_of(source), scene, job=job.name, with_data=job.reads_data(scene)).digest()
    return hashlib.sha256(f"{digest}\0{[*cells]}".encode()).hexdigest()[:12]


# --- the comparison ---------------------------------------------------------------------------------------------------


def compared(cells: Sequence[float], found: Sequence[dict[str, Quantity] | None]) -> dict[str, OnGrids]:
    """Return every quantity on all grids, and extrapolated; `found` has those of each grid, None if its run failed."""
    everything = [each or {} for each in found]
    floors: dict[str, float] = {}
    for quantity in (quantity for each in everything for quantity in each.values()):
        floors[quantity.unit] = max(floors.get(quantity.unit, 0.0), ROUNDING * abs(quantity.value))
    names = dict.fromkeys(name for each in everything for name in each)
    return {name: _compared(cells, [each.get(name) for each in everything], floors) for name in names}


def _compared(cells: Sequence[float], each: Sequence[Quantity | None], floors: dict[str, float]) -> OnGrids:
    """Return one quantity on all grids."""
    known = [quantity for quantity in each if quantity is not None]
    values = [None if quantity is None else quantity.value for quantity in each]
    missing = [number(dx) for dx, quantity in zip(cells, each, strict=True) if quantity is None]
    ended = [(dx, q.bound) for dx, q in zip(cells, each, strict=True) if q is not None and q.bound is not None]
    bound = [f"{number(end)} with cells of {number(dx)} m" for dx, end in ended]
    unit = known[0].unit
    if missing or bound:
        why = f"has no value with cells of {listed(missing)} m" if missing else f"ended at a bound: {listed(bound)}"
        return OnGrids(unit=unit, values=values, value=None, error=None, order=None, how=None, note=why)
    numbers = [quantity.value for quantity in known]
    end = extrapolate(cells, numbers, log=known[0].log, floor=floors[unit])
    value, note, interval = max(end.value, known[-1].least), None, known[-1].interval
    if interval is not None and not interval[0] <= value <= interval[1]:
        note = (
            f"the extrapolated value is outside the 95 % interval on the finest grid, {number(interval[0])} to "
            f"{number(interval[1])}, which covers only the noise of the data"
        )
    return OnGrids(unit=unit, values=values, value=value, error=end.error, order=end.order, how=end.how, note=note)


def _table(study: Resolution) -> Iterator[list[object]]:
    """Yield one row per quantity."""
    grids = [f"dx={grid.dx!r}" for grid in study.grids]
    yield ["quantity", "unit", *grids, "extrapolated", "error", "order", "how", "note"]
    for name, q in study.quantities.items():
        yield [name, q.unit, *q.values, q.value, q.error, q.order, q.how, q.note]


# --- the report -------------------------------------------------------------------------------------------------------


def runs_of(path: Path) -> list[Path]:
    """Return the directories of the runs of a study that did not fail."""
    return [path_of(grid.run) for grid in read_resolution(path).grids if grid.status != "failed"]


def resolution_lines(path: Path) -> list[str]:
    """Return a study as lines for a terminal."""
    study = read_resolution(path)
    cells = [number(grid.dx) for grid in study.grids]
    ended = sum(grid.status != "failed" for grid in study.grids)
    lines = [f"{ended} of {len(cells)} grids ended, with cells of {listed(cells)} m"]
    for grid in study.grids:
        lines += [f"cells of {number(grid.dx)} m: {name} has {resolved(part)}" for name, part in grid.thinnest.items()]
    head = ("quantity", "unit", *(f"dx {cell} m" for cell in cells), "extrapolated", "error", "order")
    rows = [(name, *cells_of(quantity)) for name, quantity in study.quantities.items()]
    lines += ["", *table(head, rows), "", *how_extrapolated(study)] if rows else []
    lines += [f"note: {name}: {q.note}" for name, q in study.quantities.items() if q.note]
    lines += [f"note: {sentence}" for sentence in study.notes]
    lines += [f"cells of {number(g.dx)} m: {g.status}: {g.reason}" for g in study.grids if g.status == "failed"]
    lines += [f"run with cells of {number(g.dx)} m: {path_of(g.run)}" for g in study.grids]
    return [*lines, f"resolution: {path}"]


def cells_of(quantity: OnGrids) -> Iterator[str]:
    """Yield a quantity as cells of a table: unit, values, extrapolated value, error with two digits, order."""
    yield quantity.unit
    yield from ("-" if value is None else number(value) for value in (*quantity.values, quantity.value))
    yield "-" if quantity.error is None else number(float(f"{quantity.error:.2g}"))
    words = {None: "-", "equal": "same on all", "assumed": "2, assumed", "uneven": "uneven"}
    yield f"{quantity.order:.2f}" if quantity.how == "observed" else words[quantity.how]


def how_extrapolated(study: Resolution) -> Iterator[str]:
    """Yield how values were extrapolated, and what their error means."""
    how = {quantity.how for quantity in study.quantities.values()}
    ratio = study.grids[-2].dx / study.grids[-1].dx
    times = number(1.0 / (ratio - 1.0))
    if "observed" in how:
        yield (
            f"An order between {LOWEST:g} and {HIGHEST:g} was found from three grids; the error is {SAFETY:g} times "
            "the distance from the finest grid's value to the extrapolated one."
        )
    if "assumed" in how:
        yield (
            "Two grids do not show the order of convergence: the values are those of order 2. The error is the "
            f"distance from the finest grid's value to that of order 1, {times} times the change between the grids, "
            "and covers both."
        )
    if "uneven" in how:
        yield (
            "uneven: the values do not converge evenly, so three grids show no order. The value is that of order 2 "
            f"from the two finest grids; the error is {times} times their change, or the range of all values if that "
            "is more."
        )
