"""Write a page about a study: a sweep, several grids, several seeds, or an ablation."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

from cqrun.errors import CqrunError, UsageError
from cqrun.explain import listed
from cqrun.figures.ablation import draw_ablation
from cqrun.figures.run_data import RunData, read_run
from cqrun.figures.sweep import draw_sweep
from cqrun.jobs.studies.ablation import ablation_lines
from cqrun.jobs.studies.resolution import resolution_lines
from cqrun.jobs.studies.seeds import summary_lines
from cqrun.jobs.studies.sweep import sweep_lines
from cqrun.report.blocks import Block, Cell, Code, Folded, Link, Notes, Page, Picture, Section, Table
from cqrun.report.grid import study_blocks
from cqrun.report.html import write_page
from cqrun.report.several import run_sections
from cqrun.report.tables import cell, table_of
from cqrun.report.words import clipped, count, some
from cqrun.scene.keypath import shortest
from cqrun.store.folder import RECORD, REPORT
from cqrun.store.model_file import path_of
from cqrun.store.study import Resolution, read_ablation, read_resolution, read_seeds, read_sweep

RUN = "run"
"""Column of a table with the folders of the runs."""

MOST_NAMES = 5
"""Studies that a message names, at most."""


class Kind(NamedTuple):
    """A kind of study: its name, how it is read, its runs, its report at the terminal, and its picture."""

    name: str
    read: Callable[[Path], Any]
    runs: Callable[[Any], list[str]]
    lines: Callable[[Path], list[str]]
    draw: Callable[[Path], list[Path]] | None = None


KINDS = {
    "sweep": Kind("Sweep", read_sweep, lambda s: [run.run for run in s.runs], sweep_lines, draw_sweep),
    "resolution": Kind("Several grids", read_resolution, lambda s: [grid.run for grid in s.grids], resolution_lines),
    "summary": Kind("Several seeds", read_seeds, lambda s: [seed.run for seed in s.seeds.values()], summary_lines),
    "ablation": Kind(
        "Ablation", read_ablation, lambda s: [run for v in s.variants.values() for run in v.runs], ablation_lines,
        draw_ablation,
    ),
}  # fmt: skip
"""Kinds of studies by the beginning of the names of their files."""


def is_study(path: Path) -> bool:
    """Return whether a path is named like a study, or is a folder with studies and no run."""
    if path.suffix in (".json", ".csv"):
        return path.name.partition("-")[0] in KINDS
    return path.is_dir() and not (path / RECORD).exists() and bool(_inside(path))


def study_in(path: Path) -> Path:
    """Return the file (JSON) of the study that a path names: itself, its table, or the only study in a folder.

    Raises:
        UsageError: a folder has several studies.
    """
    if not path.is_dir():
        return path.with_suffix(".json")
    inside = _inside(path)
    if len(inside) > 1:
        raise UsageError(f"{path}: holds several studies: give one of {listed([str(p) for p in inside], MOST_NAMES)}")
    return inside[0]


def _inside(folder: Path) -> list[Path]:
    return sorted(file for name in KINDS for file in folder.glob(f"{name}-*.json"))


def write_study_page(path: Path, out: Path | None = None, *, pictures: bool = True) -> Path:
    """Write a page about a study; return the file.

    Args:
        path: the study's file (JSON).
        out: the file; beside the study if not given.
        pictures: whether the page has pictures.

    Raises:
        UsageError: the study is missing or damaged, or the page cannot be written. RunError: the disk is full.
    """
    kind = KINDS[path.name.partition("-")[0]]
    study, out = kind.read(path), out or path.with_suffix(".html")
    folders = [_folder(path, run) for run in kind.runs(study)]
    runs, problems = _runs([folder for folder in folders if folder is not None])
    with tempfile.TemporaryDirectory(prefix="cqrun-") as folder:
        sections = [Section("found", "Result", list(_found(kind, study, path, out.parent, pictures)))]
        if problems:
            sections.append(Section("warnings", "Warnings", [Notes(problems)]))
        if runs:
            sections += run_sections(runs, Path(folder), pictures=pictures)
        ended, total = sum(run.succeeded for run in runs), len(folders)
        lead = f"{kind.name} of {count(total, 'run')}" + (f" of {runs[0].job}" if runs else "")
        badge = "all ended" if ended == total else f"{ended} of {total} ended"
        write_page(
            Page(f"{kind.name}: {clipped(study.scene)}", lead, badge, "good" if ended == total else "mixed", sections),
            out,
        )
    return out


def _folder(study: Path, run: str) -> Path | None:
    """Return the folder of a run of a study: beside the study, or where the study says; None if it is not there."""
    named = path_of(run)
    return next((p for p in (study.parent / named.name, named) if (p / RECORD).is_file()), None)


def _runs(folders: list[Path]) -> tuple[list[RunData], list[str]]:
    """Return the runs that can be read, and why others cannot."""
    runs, problems = [], []
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except CqrunError as error:
            problems.append(str(error))
    return runs, problems


def _found(kind: Kind, study: Any, path: Path, beside: Path, pictures: bool) -> Iterator[Block]:
    """Yield the table of a study and its picture."""
    if isinstance(study, Resolution):
        yield from study_blocks(study)
    else:
        yield _table(path.with_suffix(".csv"), list(getattr(study, "axes", [])), path.parent, beside)
    if pictures and kind.draw is not None:
        drawn = path.with_suffix(".png")  # perhaps of the numbers that a user wanted to see
        for picture in [drawn] if drawn.is_file() else kind.draw(path):
            axes = some(shortest(study.axes), 4) if getattr(study, "axes", []) else ""
            what = f"What the runs of the sweep found, against {axes}." if axes else "The variants side by side."
            yield Picture(picture, what, what)
    yield Folded("The report at the terminal", [Code("\n".join(kind.lines(path)))])


def _table(path: Path, axes: list[str], folder: Path, beside: Path) -> Table:
    """Return the table of a study; runs with a report of their own are links."""
    names, *rows = table_of(path)
    order = sorted(range(len(names)), key=lambda k: names[k] != RUN)
    body = [[_linked(names[k], row[k], folder, beside) for k in order] for row in rows]
    short_names = dict(zip(axes, shortest(axes), strict=True)) if axes else {}
    return Table([short_names.get(names[k], names[k]) for k in order], body, rest=f"in {path.name}")


def _linked(column: str, text: str, folder: Path, beside: Path) -> Cell:
    """Return a cell: in the column `run` a link to the report of the run, if it has one."""
    if column != RUN or not text:
        return cell(text)
    name = path_of(text).name
    linked = (folder / name / REPORT).is_file()
    return Link(name, quote(os.path.relpath(folder / name / REPORT, beside))) if linked else name
