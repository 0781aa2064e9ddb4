"""`cqrun plot`: draw what runs have found so far."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def plot(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run directories; several are compared.")],
) -> None:
    """Draw convergence and fit of one or several runs, finished or not."""
    from cqrun.figures.convergence import plot_run

    for path in plot_run(runs):
        typer.echo(path)
