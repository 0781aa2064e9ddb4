"""`cqrun validate`: check a scene without running it."""

from __future__ import annotations

import typer

from cqrun.cli.options import Overrides, Scene


def validate(scene: Scene, overrides: Overrides = None) -> None:
    """Check a scene and print its counts, masses, time step and what the run will cost."""
    from cqrun.jobs.validate import validate as lines

    for line in lines(scene, overrides or []):
        typer.echo(line)
