"""`cqrun warmup`: compile the kernels before they are needed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Quiet
from cqrun.cli.terminal import echo


def warmup(
    scenes: Annotated[
        list[Path] | None, typer.Argument(metavar="[SCENE...]", help="Scenes whose kernels are compiled.")
    ] = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Compile the kernels of SCENE..., or the common ones, into the cache, so that the next run starts at once."""
    from cqrun.cli.progress import working

    with working(quiet, allow_plugins, "building scenes") as reporter:
        from cqrun.jobs.warmup import warmup as compile_kernels

        for line in compile_kernels(scenes or (), reporter=reporter):
            echo(line)
