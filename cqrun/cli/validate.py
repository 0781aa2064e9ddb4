"""`cqrun validate`: check a scene without running it."""

from __future__ import annotations

from cqrun.cli.options import AllowPlugins, Overrides, Scene
from cqrun.cli.terminal import echo


def validate(scene: Scene, overrides: Overrides = None, allow_plugins: AllowPlugins = False) -> None:
    """Check a scene and print its counts, masses, resolution, time step and the cost of the run.

    The scene is checked for the job that it names; use `-o job=control` to check it for another job.
    """
    from cqrun.cli.progress import working

    with working(False, allow_plugins, f"checking {scene}"):
        from cqrun.jobs.validate import validate as validation_lines

        lines = list(validation_lines(scene, overrides or []))
    for line in lines:
        echo(line)
