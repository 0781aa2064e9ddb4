"""`cqrun export`: write results of a run for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Quiet, Run
from cqrun.cli.terminal import echo


def export(
    run: Run,
    design: Annotated[
        bool,
        typer.Option("--design", help="The designed body: a table of its particles, VTK, its surface (the default)."),
    ] = True,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder to write to; the run's design/ if not given.")
    ] = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Write the body that a run has designed: per-particle CSV with units, VTKHDF for ParaView, surface or outline.

    For an unfinished run this is the best design so far.
    """
    from cqrun.cli.progress import working

    with working(quiet, allow_plugins, f"reading {run}") as reporter:
        from cqrun.jobs.export import export_design

        paths = export_design(run, out or run / "design", reporter)
    for path in paths:
        echo(path)
