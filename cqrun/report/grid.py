"""Section: whether the grid is fine enough."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from cqrun.build.check_grid import CELLS
from cqrun.errors import UsageError
from cqrun.jobs.studies.resolution import COMPARED, cells_of, how_extrapolated
from cqrun.report.blocks import Block, Notes, Table, Text
from cqrun.report.subject import Subject
from cqrun.report.words import short, with_unit
from cqrun.store.model_file import path_of
from cqrun.store.study import Resolution, read_resolution
from cqrun.store.thinnest import Thinnest

MOST_STUDIES = 3
"""Studies of several grids that are shown, at most."""

JUST = 0.99
"""Bodies of exactly the number of cells that is needed may miss it by rounding."""


def grid(subject: Subject) -> Iterator[Block]:
    """Yield the cells across the thinnest part of each body, and the studies of several grids with this run."""
    parts: dict[str, Thinnest] = getattr(subject.run.result, "thinnest", {})
    if parts:
        head = ("body", "thinnest part", "cells across it", "particles across it")
        rows = [(name, with_unit(part.thickness, "m"), f"{part.cells:.2g}", f"{part.particles:.2g}")
                for name, part in parts.items()]  # fmt: skip
        yield Table(head, rows, rest="in result.json")
        if thin := [name for name, part in parts.items() if part.cells < JUST * CELLS]:
            yield Notes([f"{name}: fewer than {CELLS} cells across the thinnest part. It bends too far."
                         for name in thin])  # fmt: skip
    studies = list(_studies(subject.run.path))[:MOST_STUDIES]
    for study in studies:
        yield from study_blocks(study)
    if parts and not studies and subject.run.job in COMPARED:
        yield Text(
            f"No other grid was run. `cqrun {subject.run.job} SCENE --resolution` runs a finer one, and estimates how "
            "much the results depend on the cells."
        )


def _studies(run: Path) -> Iterator[Resolution]:
    """Yield the studies of several grids beside a run that include it."""
    run = run.resolve()
    for file in sorted(run.parent.glob("resolution-*.json")):
        try:
            study = read_resolution(file)
        except UsageError:  # damaged: `cqrun report` on that file says so
            continue
        if any(path_of(grid.run).name == run.name for grid in study.grids):
            yield study


def study_blocks(study: Resolution) -> Iterator[Block]:
    """Yield what several grids show: each quantity on all grids, and extrapolated to a cell size of zero."""
    cells = [f"{short(1e3 * grid.dx)} mm" for grid in study.grids]
    if study.quantities:
        head = ("quantity", "unit", *(f"cells of {cell}" for cell in cells), "extrapolated", "error", "order")
        rows = [(name, *cells_of(quantity)) for name, quantity in study.quantities.items()]
        yield Table(head, rows, "The same scene on several grids, extrapolated to a cell size of zero")
        yield from (Text(words) for words in how_extrapolated(study))
    notes = [f"{name}: {quantity.note}" for name, quantity in study.quantities.items() if quantity.note]
    notes += [*study.notes, *(f"Cells of {short(1e3 * grid.dx)} mm: {grid.status}: {grid.reason}"
                              for grid in study.grids if grid.status == "failed")]  # fmt: skip
    if notes:
        yield Notes(notes, mild=True)
