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
    from cqrun.cli.progress import working
    from cqrun.cli.results import draw_and_print_run, infeasible_shown

    with infeasible_shown(quiet, allow_plugins):
        with working(quiet, allow_plugins, f"reading {run}") as reporter:
            from cqrun.jobs.resume import run_resume

            continued = run_resume(run, overrides or [], threads=threads, reporter=reporter)
        draw_and_print_run(continued, quiet, allow_plugins)
