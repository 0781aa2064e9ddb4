"""Write the report of a run: report.html in its folder."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from cqrun.errors import CqrunError, UsageError
from cqrun.figures.draw import draw_run
from cqrun.figures.run_data import RunData, read_run
from cqrun.jobs.table import job_of
from cqrun.report.asked import task
from cqrun.report.blocks import Mood, Page
from cqrun.report.film import make_film
from cqrun.report.html import write_page
from cqrun.report.sections import sections_of
from cqrun.report.subject import Film, Subject
from cqrun.report.words import clipped
from cqrun.store.folder import REPORT


def write_report(
    path: Path, out: Path | None = None, *, pictures: bool = True, drawn: Sequence[Path] | None = None
) -> Path:
    """Write the report of a run, which need not be finished; return the file.

    Args:
        path: the run directory.
        out: the file; report.html in the run if not given.
        pictures: whether the page has pictures and a film.
        drawn: the pictures of the run if they are drawn already.

    Raises:
        UsageError: the path is not a run, one of its files is damaged, or the page cannot be written.
        SceneError: this version cannot read the scene. RunError: the disk is full.
    """
    run = read_run(path)
    with tempfile.TemporaryDirectory(prefix="cqrun-") as folder:
        subject = subject_of(run, Path(folder), pictures=pictures, film=pictures, drawn=drawn)
        file = out or path / REPORT
        write_page(page_of(subject), file)
    return file


def subject_of(
    run: RunData, folder: Path, *, pictures: bool, film: bool, drawn: Sequence[Path] | None = None
) -> Subject:
    """Return a run with its pictures and its film; what cannot be drawn is explained on the page.

    Args:
        folder: where pictures and films are drawn.
        pictures, film: whether they are wanted.
        drawn: the pictures if they are drawn already.
    """
    shown, why = tuple(p for p in drawn or () if p.suffix == ".png"), ""
    if pictures and drawn is None and job_of(run.path).pictures:
        try:
            shown = tuple(draw_run(run.path, folder=folder))
        except UsageError as error:
            why = str(error)
    return Subject(run, shown if pictures else (), why, _film(run, folder) if film else None)


def _film(run: RunData, folder: Path) -> Film | None:
    try:
        return make_film(run, folder)
    except CqrunError as error:  # the trajectory is damaged, or still empty
        return Film(why=str(error))


def page_of(subject: Subject) -> Page:
    """Return the page of a run.

    Raises:
        UsageError: a file of the run is damaged.
    """
    run = subject.run
    title, words = clipped(run.scene.title or run.name), task(subject)
    return Page(title, f"{words[:1].upper()}{words[1:]}", run.status, mood_of(run), sections_of(subject))


def mood_of(run: RunData) -> Mood:
    """Return whether a run is a success: it ended as it should."""
    status = str(run.record["status"])
    return "good" if status in ("done", "converged") else "bad" if status in ("failed", "infeasible") else "mixed"
