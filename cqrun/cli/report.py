"""`cqrun report`: write a page about runs, which needs no other file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Quiet
from cqrun.cli.terminal import echo
from cqrun.store.places import DEFAULT_OUT


def report(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Run directories; or one study (sweep-....json), or its folder."),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="FILE", help="File to write (.html); report.html in the run if not given."),
    ] = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Write a report as one web page without other files: results, warnings, pictures, methods, scene, versions.

    A run writes its report when it ends. Give several runs to compare them, or a sweep or another study. A run need not
    be finished. CQRUN_PICTURES=0 in the environment leaves out pictures and films.
    """
    from cqrun.cli.progress import working
    from cqrun.cli.results import pictures_wanted

    with working(quiet, allow_plugins, "writing the report"):
        from cqrun.report.write import write

        path = write(runs, output, DEFAULT_OUT, pictures=pictures_wanted())
    echo(path)
