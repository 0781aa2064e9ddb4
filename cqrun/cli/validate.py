"""`cqrun validate`: check a scene without running it."""

from __future__ import annotations

import typer

from cqrun.cli.options import AllowPlugins, Overrides, Scene


def validate(scene: Scene, overrides: Overrides = None, allow_plugins: AllowPlugins = False) -> None:
    """Check a scene and print its counts, masses, time step and what the run will cost.

    It is checked for the job that it names; for another with `-o job=control`.
    """
    from cqrun.jobs.validate import validate as lines
    from cqrun.scene.plugin_files import plugins_allowed

    with plugins_allowed(allow_plugins):
        for line in lines(scene, overrides or []):
            typer.echo(line)
