"""Finish a command: draw pictures in the run, and print results on standard output."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

PICTURES = "CQRUN_PICTURES"
"""Environment variable: 0 means that no pictures are drawn when a run is finished, for example in large studies."""


def print_run(run: Path) -> None:
    """Print the results of a run, and its directory."""
    from cqrun.jobs.table import report_lines

    for line in report_lines(run):
        typer.echo(line)
    typer.echo(f"run: {run}")


def draw_and_print_run(run: Path) -> None:
    """Draw a run, if its job has pictures, and print it; an error while drawing does not make the run fail.

    Raises:
        UsageError, RunError: the pictures cannot be written.
    """
    from cqrun.figures.draw import draw_run, has_pictures

    try:
        _draw(lambda: has_pictures(run) and draw_run(run), f"`cqrun plot {run}` shows the details")
    finally:
        print_run(run)


def draw_and_print_ablation(comparison: Path, succeeded: bool) -> None:
    """Draw and print the comparison of variants; exit with 1 if a run failed. Raises as `draw_and_print_run`."""
    from cqrun.figures.ablation import draw_ablation
    from cqrun.jobs.studies.ablation import ablation_lines

    try:
        _draw(lambda: draw_ablation(comparison), f"the numbers are in {comparison}")
    finally:
        for line in ablation_lines(comparison):
            typer.echo(line)
    if not succeeded:
        raise typer.Exit(1)


def _draw(draw: Callable[[], object], advice: str) -> None:
    """Draw, unless pictures are switched off; a bug in drawing is only a warning, so that the results are printed."""
    from cqrun.errors import CqrunError

    if os.environ.get(PICTURES) == "0":
        return
    try:
        draw()
    except CqrunError:
        raise
    except Exception as error:
        typer.echo(f"warning: no pictures: {type(error).__name__}: {error}; {advice}", err=True)


@contextmanager
def infeasible_shown() -> Iterator[None]:
    """Also draw and print a run that ended infeasible, before its error is shown."""
    from cqrun.errors import InfeasibleError

    try:
        yield
    except InfeasibleError as error:
        draw_and_print_run(error.run)
        raise


def require_seeds_for_jobs(seeds: int | None, jobs: int | None) -> None:
    """Raise a UsageError if a number of runs at once is given, but only one run."""
    from cqrun.errors import UsageError

    if seeds is None and jobs is not None:
        raise UsageError(f"--jobs {jobs}: is the number of seeds that run at once: add --seeds N")


def print_seeds(summary: Path, succeeded: bool) -> None:
    """Print the results of several seeds; exit with 1 if one failed."""
    from cqrun.jobs.studies.seeds import summary_lines

    for line in summary_lines(summary):
        typer.echo(line)
    if not succeeded:
        raise typer.Exit(1)
