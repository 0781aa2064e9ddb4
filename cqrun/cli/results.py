"""What a finished command prints: results on standard output."""

from __future__ import annotations

from pathlib import Path

import typer


def print_run(run: Path) -> None:
    """Print what a run found, and where it lies."""
    from cqrun.jobs.report import report_lines

    for line in report_lines(run):
        typer.echo(line)
    typer.echo(f"run: {run}")
