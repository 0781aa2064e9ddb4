"""What a finished command leaves: pictures in the run, results on standard output."""

from __future__ import annotations

from pathlib import Path

import typer


def print_run(run: Path) -> None:
    """Print what a run found, and where it lies."""
    from cqrun.jobs.report import report_lines

    for line in report_lines(run):
        typer.echo(line)
    typer.echo(f"run: {run}")


def draw_and_print_run(run: Path) -> None:
    """Draw a run, if its job has pictures, then print it; what it found is printed even if drawing fails.

    Raises:
        UsageError, RunError: the pictures cannot be written.
    """
    from cqrun.figures.draw import draw_run, has_pictures

    try:
        if has_pictures(run):
            draw_run(run)
    finally:
        print_run(run)
