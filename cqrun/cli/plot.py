"""`cqrun plot`: draw the results of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins
from cqrun.cli.terminal import echo
from cqrun.store.places import DEFAULT_OUT

KINDS = ("png", "pdf")


def plot(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run directories; several are compared.")],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for a comparison; pictures of one run go into the run."),
    ] = None,
    show: Annotated[
        str | None,
        typer.Option(
            "--show",
            metavar="TERM",
            help="Quantity to compare: loss (the default), a term of the objective, a constraint, violation or kkt; "
            "of simulations and equilibria a quantity that they measure (the default is all).",
        ),
    ] = None,
    allow_plugins: AllowPlugins = False,
) -> None:
    """Draw convergence and fit of a run into its figures/, or compare several runs, as PNG and PDF.

    Of simulations and equilibria, the picture has a line for each run in a panel for each quantity that they measure.

    Runs need not be finished. Three or more runs that differ only in their seeds are drawn as their mean with its 90 %
    interval; on a logarithmic axis it is the geometric mean.
    """
    from cqrun.cli.progress import working

    for file in [run for run in runs if run.is_file()]:  # results/SCENE/* includes summaries of several runs
        echo(f"skipped: {file} is a file and not a run", err=True)
    runs = [run for run in runs if not run.is_file()] or runs
    with working(False, allow_plugins, "drawing pictures"):
        from cqrun.figures.draw import draw_run, draw_several
        from cqrun.store.folder import make_below

        if len(runs) == 1 and show is None:
            paths = draw_run(runs[0], KINDS)
        else:
            if out is None:
                out = make_below(runs[0] if len(runs) == 1 else DEFAULT_OUT, "figures")
            paths = draw_several(runs, out, KINDS, show)
    for path in paths:
        echo(path)
