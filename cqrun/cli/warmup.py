"""`cqrun warmup`: compile the kernels before they are needed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import Quiet


def warmup(
    scenes: Annotated[
        list[Path] | None, typer.Argument(metavar="[SCENE...]", help="Scenes whose kernels are wanted.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Compile kernels into the cache, so that the next run starts at once: of SCENE..., or the common ones."""
    from cqrun.cli.progress import reporting
    from cqrun.jobs.warmup import warmup as compile_kernels

    with reporting(quiet) as reporter:
        for line in compile_kernels(scenes or (), reporter=reporter):
            typer.echo(line)
