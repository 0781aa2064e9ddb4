"""`cqrun resume`: continue a run, or extend a finished one."""

from __future__ import annotations

from cqrun.cli.options import AllowPlugins, Overrides, Quiet, Run, Threads


def resume(
    run: Run,
    overrides: Overrides = None,
    threads: Threads = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Continue a run from its directory; `-o optimizer.NAME.max_iterations=N` extends a finished run."""
    from cqrun.cli.progress import reporting
    from cqrun.cli.results import draw_and_print_run, infeasible_shown
    from cqrun.jobs.resume import run_resume
    from cqrun.scene.plugin_files import plugins_allowed

    with plugins_allowed(allow_plugins), infeasible_shown():
        with reporting(quiet) as reporter:
            continued = run_resume(run, overrides or [], threads=threads, reporter=reporter)
        draw_and_print_run(continued)
