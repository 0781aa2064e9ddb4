"""`cqrun plot`: draw what runs have found so far."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import DEFAULT_OUT, AllowPlugins

FIGURES = DEFAULT_OUT / "figures"
KINDS = ("png", "pdf")


def plot(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run directories; several are compared.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Where a comparison goes; one run keeps its pictures.")
    ] = FIGURES,
    show: Annotated[
        str | None,
        typer.Option(
            "--show",
            metavar="TERM",
            help="What is compared: loss, as if not given, a term of the objective, a constraint, violation, kkt.",
        ),
    ] = None,
    allow_plugins: AllowPlugins = False,
) -> None:
    """Draw convergence and fit of a run, finished or not, into its figures/; compare several. PNG and PDF.

    Runs that differ in their seeds alone are drawn as their mean with its 90 % interval, three or more of them; on a
    logarithmic axis it is the geometric mean.
    """
    from cqrun.figures.draw import draw_run, draw_several
    from cqrun.scene.plugin_files import plugins_allowed

    for file in [run for run in runs if run.is_file()]:  # of results/SCENE/*: what sums up several runs
        typer.echo(f"left out: {file} is a file, no run", err=True)
    runs = [run for run in runs if not run.is_file()] or runs
    with plugins_allowed(allow_plugins):
        one = len(runs) == 1 and show is None
        place = runs[0] / "figures" if len(runs) == 1 and out == FIGURES else out
        paths = draw_run(runs[0], KINDS) if one else draw_several(runs, place, KINDS, show)
    for path in paths:
        typer.echo(path)
