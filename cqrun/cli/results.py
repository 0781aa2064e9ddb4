"""What a finished command leaves: pictures in the run, results on standard output."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import typer

PICTURES = "CQRUN_PICTURES"
"""Environment variable: 0 draws nothing when a run is finished, as of hundreds that nobody looks at one by one."""


def print_run(run: Path) -> None:
    """Print what a run found, and where it lies."""
    from cqrun.jobs.table import report_lines

    for line in report_lines(run):
        typer.echo(line)
    typer.echo(f"run: {run}")


def draw_and_print_run(run: Path) -> None:
    """Draw a run, if its job has pictures, then print it; a picture that cannot be drawn makes no run fail.

    Raises:
        UsageError, RunError: the pictures cannot be written.
    """
    from cqrun.figures.draw import draw_run, has_pictures

    try:
        _draw(lambda: has_pictures(run) and draw_run(run), f"`cqrun plot {run}` tells more")
    finally:
        print_run(run)


def draw_and_print_ablation(found: Path, good: bool) -> None:
    """Draw how variants compare, then print it; exit with 1 where a run failed. Raises as `draw_and_print_run`."""
    from cqrun.figures.ablation import draw_ablation
    from cqrun.jobs.studies.ablation import ablation_lines

    try:
        _draw(lambda: draw_ablation(found), f"the numbers are in {found}")
    finally:
        for line in ablation_lines(found):
            typer.echo(line)
    if not good:
        raise typer.Exit(1)


def _draw(draw: Callable[[], object], advice: str) -> None:
    """Draw, where pictures are wanted; a fault of ours is told: what was found is worth more than how it looks."""
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
    """Draw and print a run that ended infeasible, too, before its verdict."""
    from cqrun.errors import InfeasibleError

    try:
        yield
    except InfeasibleError as error:
        draw_and_print_run(error.run)
        raise


def require_seeds_for_jobs(seeds: int | None, jobs: int | None) -> None:
    """Refuse a number of runs at once where there is but one."""
    from cqrun.errors import UsageError

    if seeds is None and jobs is not None:
        raise UsageError(f"--jobs {jobs}: says how many of several seeds run at once: add --seeds N")


def print_seeds(summary: Path, good: bool) -> None:
    """Print what several seeds found; exit with 1 where one failed."""
    from cqrun.jobs.studies.seeds import summary_lines

    for line in summary_lines(summary):
        typer.echo(line)
    if not good:
        raise typer.Exit(1)
