"""`cqrun compress`: learn an observer of a body's deformation from runs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import Quiet


class Method(StrEnum):
    """How deformation becomes few numbers."""

    pca = "pca"
    vae = "vae"


def compress(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run directories with a trajectory.")],
    output: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="Where the observer's file goes (.npz).")],
    method: Annotated[Method, typer.Option(help="Principal components, or an autoencoder (extra torch).")] = Method.pca,
    size: Annotated[int, typer.Option(min=1, help="How many numbers.")] = 6,
    body: Annotated[str | None, typer.Option(help="Whose motion; needed where a run has several bodies.")] = None,
    cells: Annotated[int, typer.Option(min=4, help="Cells along each axis that the autoencoder sees.")] = 16,
    epochs: Annotated[int, typer.Option(min=1, help="Times the autoencoder sees every frame.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Of the autoencoder's training.")] = 0,
    quiet: Quiet = False,
) -> None:
    """Learn from runs how a body deforms, in few numbers: a file for the observers pca and vae."""
    from cqrun.cli.progress import reporting
    from cqrun.jobs.compress import compress as learn

    with reporting(quiet) as reporter:
        said = learn(
            runs, method.value, size, output, body=body, cells=cells, epochs=epochs, seed=seed, reporter=reporter
        )
    typer.echo(said)
    typer.echo(f"written: {output}")
