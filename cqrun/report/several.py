"""Write one page about several runs: what differs between their scenes, what they found, and each run folded."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from cqrun.errors import UsageError
from cqrun.explain import Loc
from cqrun.figures.draw import draw_several
from cqrun.figures.overlay import FORWARD
from cqrun.figures.quantities import capitalised
from cqrun.figures.run_data import RunData, read_run
from cqrun.jobs.table import job_of
from cqrun.report.asked import task
from cqrun.report.blocks import Block, Cell, Folded, Link, Notes, Page, Picture, Section, Table, Text
from cqrun.report.cite import citation
from cqrun.report.html import write_page
from cqrun.report.page import subject_of
from cqrun.report.sections import OF_ALL, sections_of
from cqrun.report.subject import Subject
from cqrun.report.words import clipped, count, short, some
from cqrun.running.cost import duration
from cqrun.scene.keypath import joined, shortest
from cqrun.scene.load import resolve
from cqrun.store.folder import FIGURES, REPORT
from cqrun.store.result import LearnedResult, Result, Search, SimulateResult, SysidResult, values_in

MOST_RUNS = 8
"""Runs whose whole reports are on a page, at most; others are only in its tables."""

MOST_FILMS = 2
"""If there are more runs, the page has no films."""

MOST_KEYS = 40
"""Key paths that differ between the scenes, at most."""

OPEN = {"found", "warnings"}
"""Sections that are shown when a run is unfolded."""

LONGEST_VALUE = 60
"""Letters of a value in a table, at most."""


def write_several(paths: Sequence[Path], out: Path, *, pictures: bool = True) -> Path:
    """Write one page about several runs; return the file.

    Raises:
        UsageError: a path is not a run, or one of its files is damaged. SceneError: this version cannot read a scene.
        RunError: the disk is full.
    """
    runs = [read_run(path) for path in paths]
    names = list(dict.fromkeys(run.name for run in runs))
    with tempfile.TemporaryDirectory(prefix="cqrun-") as folder:
        sections = [Section("compared", "Side by side", [*_compared(runs), *_overlay(runs, Path(folder), pictures)])]
        if links := [_link(run, out.parent) for run in runs if (run.path / REPORT).is_file()]:
            sections.append(Section("reports", "Report of each run", [Table(("run",), [(link,) for link in links])]))
        sections += run_sections(runs, Path(folder), pictures=pictures)
        ended = sum(run.succeeded for run in runs)
        badge = "all ended" if ended == len(runs) else f"{ended} of {len(runs)} ended"
        title = f"{count(len(runs), 'run')} of {some(names, 3)}"
        lead = capitalised(some(dict.fromkeys(task_of(run) for run in runs), 3))
        write_page(Page(title, lead, badge, "good" if ended == len(runs) else "mixed", sections), out)
    return out


def task_of(run: RunData) -> str:
    """Return what a run does, in words."""
    return task(Subject(run))


def run_sections(runs: Sequence[RunData], folder: Path, *, pictures: bool) -> list[Section]:
    """Return a section of the whole reports of runs, folded, and one on how to cite.

    Args:
        folder: where pictures and films are drawn.
        pictures: whether they are wanted.
    """
    blocks: list[Block] = []
    for k, run in enumerate(runs[:MOST_RUNS]):
        place = folder / str(k)
        place.mkdir()
        films = pictures and len(runs) <= MOST_FILMS
        subject = subject_of(run, place, pictures=pictures, film=films, drawn=_drawn(run))
        blocks.append(Folded(f"{_label(run)}: {run.status}", list(_of_run(subject))))
    if len(runs) > MOST_RUNS:
        blocks.append(Text(
            f"The page has the whole reports of the first {MOST_RUNS} runs, to stay small. `cqrun report RUN` writes "
            "that of any other."
        ))  # fmt: skip
    first = Subject(runs[0])
    cite = Section("cite", "How to cite", list(citation(first.fact("versions", "cqrun"), first.fact("engine"))))
    return [Section("runs", "Each run", blocks), cite]


def _drawn(run: RunData) -> list[Path] | None:
    """Return the pictures that a run drew when it ended; None if it has none, so that they are drawn for the page."""
    names = {*job_of(run.path).pictures} - {"tracks"}
    drawn = [p for p in sorted((run.path / FIGURES).glob("*.png")) if p.stem in names or p.stem.startswith("tracks_")]
    return drawn if drawn and run.succeeded else None


def _of_run(subject: Subject) -> Iterator[Block]:
    for section in sections_of(subject):
        if section.name in OPEN:
            yield from section.blocks
        elif section.name not in OF_ALL:
            yield Folded(section.title, section.blocks)


def _label(run: RunData) -> str:
    return f"{run.name}/{run.path.resolve().name}"


def _link(run: RunData, beside: Path) -> Link:
    """Return a link to a run's own report, relative to the folder of the page."""
    return Link(_label(run), quote(os.path.relpath((run.path / REPORT).resolve(), beside.resolve())))


# --- the comparison ---------------------------------------------------------------------------------------------------


def _compared(runs: Sequence[RunData]) -> Iterator[Block]:
    """Yield tables with a column for each run: what differs between the scenes, and what was found."""
    one_scene = len({run.name for run in runs}) == 1  # then hashes alone are shorter columns
    head = ("", *(run.path.resolve().name if one_scene else _label(run) for run in runs))
    ends = [("status", *(run.status for run in runs)),
            ("time taken", *(duration(float(run.record["seconds"])) for run in runs))]  # fmt: skip
    asked = _differences([dict(_leaves(resolve(run.scene))) for run in runs])
    if asked:
        yield Table(head, asked, "What differs between the scenes", rest="in scene.yaml of each run")
    else:
        yield Text("The scenes do not differ.")
    found = _side_by_side([dict(_found(run)) for run in runs])
    yield Table(head, [*ends, *found], "What was found")
    if findings := [f"{_label(run)}: {words}" for run in runs for words in getattr(run.result, "findings", [])]:
        yield Notes(findings)


def _overlay(runs: Sequence[RunData], folder: Path, pictures: bool) -> Iterator[Block]:
    """Yield the picture of what simulations or equilibria measure, if their curves have a common axis."""
    if not pictures or any(run.job not in FORWARD for run in runs):
        return
    try:
        (path,) = draw_several([run.path for run in runs], folder)
    except UsageError:
        return
    yield Picture(path, "What the runs measure, a line for each run.", "What the runs measure, a line for each run.")


def _leaves(value: Any, loc: Loc = ()) -> Iterator[tuple[str, str]]:
    """Yield key path and value of everything in plain data; a list of numbers is one value."""
    if isinstance(value, dict) and value:
        for key, inside in value.items():
            yield from _leaves(inside, (*loc, key))
    elif isinstance(value, list) and any(isinstance(item, dict | list) for item in value):
        for k, inside in enumerate(value):
            yield from _leaves(inside, (*loc, k))
    else:
        yield joined(loc), clipped(_plain(value), LONGEST_VALUE)


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"[{', '.join(map(_plain, value))}]" if isinstance(value, list) else str(value)


def _differences(scenes: Sequence[Mapping[str, str]]) -> list[tuple[str, ...]]:
    """Return a row for each key path whose value is not the same in all scenes."""
    paths = dict.fromkeys(path for scene in scenes for path in scene)
    rows = [(path, *(scene.get(path, "-") for scene in scenes)) for path in paths]
    rows = [row for row in rows if len(set(row[1:])) > 1]
    titles = shortest([row[0] for row in rows]) if rows else []
    return [(title, *row[1:]) for title, row in zip(titles[:MOST_KEYS], rows, strict=False)]


def _side_by_side(columns: Sequence[Mapping[str, str]]) -> list[Sequence[Cell]]:
    names = dict.fromkeys(name for column in columns for name in column)
    return [(name, *(column.get(name, "-") for column in columns)) for name in names]


def _found(run: RunData) -> Iterator[tuple[str, str]]:
    """Yield the numbers that a run found, by name: its loss first."""
    result: Result | None = run.result
    if isinstance(result, SysidResult) and result.loss is not None:
        yield "loss", f"{short(result.loss)} {run.scene.loss_unit}".rstrip()
    if isinstance(result, LearnedResult):
        yield from ((f"loss, {name}", short(stage.loss)) for name, stage in result.stages().items())
        yield from ((f"constraint {name}", short(value.value)) for name, value in result.constraints.items())
    if isinstance(result, Search):
        yield "iterations", str(result.iterations)
    if isinstance(result, SimulateResult):
        for name, motion in result.bodies.items():
            yield f"{name}: top speed [m/s]", short(motion.fastest)
            yield f"{name}: centroid at the end [m]", ", ".join(map(short, motion.centroid))
    yield from _values(run, result)


def _values(run: RunData, result: Result | None) -> Iterator[tuple[str, str]]:
    """Yield the unknowns with their intervals."""
    subject, values = Subject(run), values_in(result)
    for title, (path, value) in zip(shortest(list(values)), values.items(), strict=True):
        unit = subject.unit(path)
        name = f"{title} [{unit}]" if unit else title
        if isinstance(value, list):
            yield name, f"{short(min(value))} to {short(max(value))} ({len(value)} values)"
            continue
        pair = result.unknowns[path].interval if isinstance(result, SysidResult) else None
        is_pair = isinstance(pair, tuple)
        yield name, short(value) + (f" ({short(pair[0])} to {short(pair[1])})" if is_pair and pair else "")  # type: ignore[arg-type]
