"""`cqrun simulate`: run a scene forward."""

from __future__ import annotations

from cqrun.cli.options import DEFAULT_OUT, AllowPlugins, Fresh, Out, Overrides, Quiet, Scene, Threads


def simulate(
    scene: Scene,
    overrides: Overrides = None,
    out: Out = DEFAULT_OUT,
    fresh: Fresh = False,
    threads: Threads = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Run a scene forward and keep its trajectory (HDF5; ParaView opens it)."""
    from cqrun.cli.progress import reporting
    from cqrun.cli.results import draw_and_print_run
    from cqrun.jobs.simulate import run_simulate
    from cqrun.scene.plugin_files import plugins_allowed

    with plugins_allowed(allow_plugins):
        with reporting(quiet) as reporter:
            run = run_simulate(scene, overrides or [], out, fresh, threads, quiet, reporter=reporter)
        draw_and_print_run(run)
