"""`cqrun control`: learn how a body should move."""

from __future__ import annotations

from cqrun.cli.options import DEFAULT_OUT, AllowPlugins, Fresh, Out, Overrides, Quiet, Scene, Threads


def control(
    scene: Scene,
    overrides: Overrides = None,
    out: Out = DEFAULT_OUT,
    fresh: Fresh = False,
    threads: Threads = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Learn a scene's controller by the gradient of its objective.

    The same command again continues the run, or says that it is finished.
    """
    from cqrun.cli.progress import reporting
    from cqrun.cli.results import draw_and_print_run
    from cqrun.jobs.control import run_control
    from cqrun.scene.plugin_files import plugins_allowed

    with plugins_allowed(allow_plugins):
        with reporting(quiet) as reporter:
            run = run_control(scene, overrides or [], out, fresh, threads, quiet, reporter=reporter)
        draw_and_print_run(run)
