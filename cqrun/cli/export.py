"""`cqrun export`: write results of a run for other programs."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Quiet, Run
from cqrun.cli.terminal import echo
from cqrun.errors import UsageError


class Tracker(StrEnum):
    """Programs that compare runs."""

    mlflow = "mlflow"
    wandb = "wandb"
    tensorboard = "tensorboard"


def export(
    run: Run,
    design: Annotated[
        bool,
        typer.Option("--design", help="The designed body: a table of its particles, VTK, its surface (the default)."),
    ] = False,
    to: Annotated[
        Tracker | None,
        typer.Option("--to", help="A finished run, for a program that compares runs; nothing leaves this machine."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Folder to write to. If not given: the run's design/, or mlruns/, wandb/ or tensorboard/ here.",
        ),
    ] = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Write the body that a run has designed, or a finished run for MLflow, W&B or TensorBoard (--to).

    The body: per-particle CSV with units, VTKHDF for ParaView, surface or outline; of an unfinished run it is the best
    design so far. A run: the values of the scene, the history, what was found, versions, tables and pictures.
    """
    if design and to is not None:
        raise UsageError(f"--design and --to {to.value} export different things: give one of the two")
    from cqrun.cli.progress import working

    with working(quiet, allow_plugins, f"reading {run}") as reporter:
        if to is not None:
            from cqrun.jobs.tracking.trackers import export_to

            exported = export_to(to.value, run, out)
            lines = [f"written: {exported.folder}", f"next: {exported.show}"]
        else:
            from cqrun.jobs.export import export_design

            lines = [str(path) for path in export_design(run, out or run / "design", reporter)]
    for line in lines:
        echo(line)
