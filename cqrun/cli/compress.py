"""`cqrun compress`: learn from runs an observer that describes a body's deformation in few numbers."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import Quiet
from cqrun.cli.terminal import echo


class Method(StrEnum):
    """Methods of compression."""

    pca = "pca"
    vae = "vae"


def compress(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run directories with a trajectory.")],
    output: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="File to write for the observer (.npz).")],
    method: Annotated[Method, typer.Option(help="Principal components, or an autoencoder (extra torch).")] = Method.pca,
    size: Annotated[int, typer.Option(min=1, help="Number of values that describe the deformation.")] = 6,
    body: Annotated[str | None, typer.Option(help="Body to observe; needed if a run has several bodies.")] = None,
    cells: Annotated[int, typer.Option(min=4, help="Cells along each axis of the autoencoder's grid.")] = 16,
    epochs: Annotated[int, typer.Option(min=1, help="Training epochs of the autoencoder.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the autoencoder's training.")] = 0,
    quiet: Quiet = False,
) -> None:
    """Learn from runs to describe a body's deformation in few numbers; the observers pca and vae read the file."""
    from cqrun.cli.progress import reporting

    with reporting(quiet, f"reading {len(runs)} runs") as reporter:
        from cqrun.jobs.compress import compress as learn

        summary = learn(
            runs, method.value, size, output, body=body, cells=cells, epochs=epochs, seed=seed, reporter=reporter
        )
    echo(summary)
    echo(f"written: {output}")
