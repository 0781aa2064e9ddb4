"""Finish a command: draw pictures in the run, write its report, and print results on standard output."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import typer

from cqrun.characters import printable
from cqrun.cli.terminal import echo

PICTURES = "CQRUN_PICTURES"
"""Environment variable: 0 means that no pictures are drawn when a run is finished, for example in large studies."""


def print_run(run: Path, allow_plugins: bool) -> None:
    """Print the results of a run, and its directory."""
    from cqrun.jobs.table import report_lines
    from cqrun.scene.plugin_files import plugins_allowed

    with plugins_allowed(allow_plugins):
        for line in report_lines(run):
            echo(line)
    echo(f"run: {printable(str(run))}")


def draw_and_print_run(run: Path, quiet: bool, allow_plugins: bool) -> None:
    """Draw a run, if its job has pictures, write its report, and print it; what is there already stays.

    An error while drawing or reporting does not make the run fail.

    Raises:
        UsageError, RunError: the pictures cannot be written. Stopped: a signal has stopped the drawing.
    """
    from cqrun.cli.progress import working
    from cqrun.jobs.table import job_of

    stopped = f"stopped while pictures were drawn; the run is finished, and `cqrun plot {run}` draws them"
    drawn: list[Path] | None = None
    try:
        if is_shown(run, allow_plugins):
            if not quiet:
                echo(_shown_already(run), err=True)
            return
        if job_of(run).pictures and pictures_wanted():
            with working(quiet, allow_plugins, "drawing pictures", stopped):
                from cqrun.figures.draw import draw_run

                drawn = _draw(lambda: draw_run(run), f"`cqrun plot {run}` shows the details")
        _report(run, drawn, quiet, allow_plugins)
    finally:
        print_run(run, allow_plugins)


def draw_and_print_ablation(comparison: Path, succeeded: bool, quiet: bool, allow_plugins: bool) -> None:
    """Draw and print the comparison of variants; exit with 1 if a run failed. Raises as `draw_and_print_run`."""
    from cqrun.cli.progress import reporting
    from cqrun.jobs.studies.ablation import ablation_lines

    stopped = f"stopped while the picture was drawn; the runs are finished, and the numbers are in {comparison}"
    try:
        if pictures_wanted():
            with reporting(quiet, "drawing the comparison", stopped):
                from cqrun.figures.ablation import draw_ablation

                _draw(lambda: draw_ablation(comparison), f"the numbers are in {comparison}")
        _report(comparison, None, quiet, allow_plugins)
    finally:
        _print_study(ablation_lines(comparison), comparison)
    if not succeeded:
        raise typer.Exit(1)


def draw_and_print_resolution(study: Path, succeeded: bool, quiet: bool, allow_plugins: bool) -> None:
    """Draw and report the run on each grid, and print what the grids show; exit with 1 if one failed.

    Raises:
        UsageError, RunError: the pictures cannot be written. Stopped: a signal has stopped the drawing.
    """
    from cqrun.cli.progress import working
    from cqrun.jobs.studies.resolution import resolution_lines, runs_of

    runs = [run for run in runs_of(study) if not is_shown(run, allow_plugins)]

    stopped = f"stopped while pictures were drawn; the runs are finished, and the numbers are in {study}"
    drawn: dict[Path, list[Path] | None] = {}
    try:
        if runs and pictures_wanted():
            with working(quiet, allow_plugins, "drawing pictures", stopped):
                from cqrun.figures.draw import draw_run

                for run in runs:
                    drawn[run] = _draw(partial(draw_run, run), f"`cqrun plot {run}` shows the details")
        for run in runs:
            _report(run, drawn.get(run), quiet, allow_plugins)
        _report(study, None, quiet, allow_plugins)
    finally:
        _print_study(resolution_lines(study), study)
    if not succeeded:
        raise typer.Exit(1)


def draw_and_print_sweep(study: Path, succeeded: bool, quiet: bool, allow_plugins: bool, show: Sequence[str]) -> None:
    """Draw and print a sweep; exit with 1 if a run failed. Raises as `draw_and_print_run`, and UsageError by `show`."""
    from cqrun.cli.progress import reporting
    from cqrun.jobs.studies.sweep import numbers_shown, sweep_lines
    from cqrun.store.study import read_sweep

    stopped = f"stopped while the picture was drawn; the runs are finished, and the numbers are in {study}"
    try:
        show = numbers_shown(read_sweep(study), show)
        with reporting(quiet, "drawing the sweep", stopped):
            from cqrun.figures.sweep import draw_sweep

            _draw(lambda: draw_sweep(study, show), f"the numbers are in {study}")
        _report(study, None, quiet, allow_plugins)
    finally:
        _print_study(sweep_lines(study, show), study)
    if not succeeded:
        raise typer.Exit(1)


def is_shown(run: Path, allow_plugins: bool) -> bool:
    """Return whether a run has all its pictures and its report: made in this order, after its result."""
    from cqrun.errors import CqrunError
    from cqrun.figures.draw import pictures_of
    from cqrun.jobs.table import job_of
    from cqrun.scene.plugin_files import plugins_allowed
    from cqrun.store.folder import REPORT
    from cqrun.store.result import result_file

    result, report = result_file(run), run / REPORT
    try:
        with plugins_allowed(allow_plugins):
            pictures = pictures_of(run) if job_of(run).pictures and pictures_wanted() else []
    except CqrunError:  # drawing reports it
        return False
    if result is None or not report.is_file() or not all(picture.is_file() for picture in pictures):
        return False
    began, *drawn, reported = (file.stat().st_mtime_ns for file in (result, *pictures, report))
    return began <= reported and all(began <= time <= reported for time in drawn)


def _shown_already(run: Path) -> str:
    """Return a sentence on how to draw and report a run again."""
    if pictures_wanted():
        return printable(f"pictures and report are there; `cqrun plot {run}` and `cqrun report {run}` make them again")
    return printable(f"the report is there; `cqrun report {run}` writes it again")


def pictures_wanted() -> bool:
    """Return whether pictures are not switched off."""
    return os.environ.get(PICTURES) != "0"


def _draw(draw: Callable[[], list[Path]], advice: str) -> list[Path] | None:
    """Draw, and return the pictures; a bug in drawing is only a warning, so that the results are printed."""
    from cqrun.errors import CqrunError

    try:
        return draw()
    except CqrunError:
        raise
    except Exception as error:
        echo(f"warning: no pictures: {type(error).__name__}: {error}; {advice}", err=True)
        return []


def _report(path: Path, drawn: list[Path] | None, quiet: bool, allow_plugins: bool) -> None:
    """Write the report of a run or a study; whatever goes wrong is only a warning, so that the results are printed.

    Raises:
        Stopped: a signal has stopped it.
    """
    from cqrun.cli.progress import working

    stopped = f"stopped while the report was written; the results are there, and `cqrun report {path}` writes it"
    with working(quiet, allow_plugins, "writing the report", stopped):
        try:
            from cqrun.report.write import write

            write([path], None, path.parent, pictures=pictures_wanted(), drawn=drawn)
        except Exception as error:
            echo(f"warning: no report: {printable(str(error))}; `cqrun report {path}` tries again", err=True)


def _print_study(lines: list[str], study: Path) -> None:
    """Print the lines of a study, and before the last one its report, if it has one."""
    report = study.with_suffix(".html")
    for line in [*lines[:-1], *([f"report: {report}"] if report.is_file() else []), *lines[-1:]]:
        echo(printable(line))


@contextmanager
def infeasible_shown(quiet: bool, allow_plugins: bool) -> Iterator[None]:
    """Also draw and print a run that ended infeasible, before its error is shown."""
    from cqrun.errors import InfeasibleError

    try:
        yield
    except InfeasibleError as error:
        draw_and_print_run(error.run, quiet, allow_plugins)
        raise


def require_seeds_for_jobs(seeds: int | None, jobs: int | None, on: str) -> None:
    """Raise a UsageError if a number of runs at once, or a place for them, is given, but only one run."""
    from cqrun.errors import UsageError

    if seeds is None and jobs is not None:
        raise UsageError(f"--jobs {jobs}: is the number of seeds that run at once: add --seeds N")
    if seeds is None and on != "processes":
        raise UsageError(f"--on {on}: is the place where several seeds run: add --seeds N")


def report_and_print_seeds(summary: Path, succeeded: bool, quiet: bool, allow_plugins: bool) -> None:
    """Report and print the results of several seeds; exit with 1 if one failed."""
    from cqrun.jobs.studies.seeds import summary_lines

    _report(summary, None, quiet, allow_plugins)
    _print_study(summary_lines(summary), summary)
    if not succeeded:
        raise typer.Exit(1)
