"""`cqrun codesign`: learn how a body should move, and what it should be."""

from __future__ import annotations

from cqrun.cli.options import DEFAULT_OUT, AllowPlugins, Fresh, Out, Overrides, Quiet, Scene, Threads


def codesign(
    scene: Scene,
    overrides: Overrides = None,
    out: Out = DEFAULT_OUT,
    fresh: Fresh = False,
    threads: Threads = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Optimise a scene's design and its controller together, under its constraints.

    The same command again continues the run, or says that it is finished.
    """
    from cqrun.cli.progress import reporting
    from cqrun.cli.results import draw_and_print_run
    from cqrun.jobs.control import run_control
    from cqrun.scene.plugin_files import plugins_allowed

    with plugins_allowed(allow_plugins):
        with reporting(quiet) as reporter:
            run = run_control(scene, overrides or [], out, fresh, threads, quiet, job="codesign", reporter=reporter)
        draw_and_print_run(run)
