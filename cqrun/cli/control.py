"""`cqrun control`: learn how a body should move."""

from __future__ import annotations

from typing import Annotated

import typer

from cqrun.cli.options import DEFAULT_OUT, AllowPlugins, Fresh, Out, Overrides, Quiet, Scene, Threads


def control(
    scene: Scene,
    overrides: Overrides = None,
    out: Out = DEFAULT_OUT,
    fresh: Fresh = False,
    threads: Threads = None,
    seeds: Annotated[
        int | None, typer.Option("--seeds", metavar="N", help="Learn from N seeds side by side, each a run of its own.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", metavar="N", help="Seeds at once; as many as threads if not given.")
    ] = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Learn a scene's controller by the gradient of its objective.

    The same command again continues the run, or says that it is finished.
    """
    from cqrun.cli.progress import reporting
    from cqrun.cli.results import draw_and_print_run
    from cqrun.errors import UsageError
    from cqrun.jobs.control import run_control
    from cqrun.jobs.seeds import run_seeds, summary_lines
    from cqrun.scene.plugin_files import plugins_allowed

    if seeds is None and jobs is not None:
        raise UsageError(f"--jobs {jobs}: says how many of several seeds run at once: add --seeds N")
    with plugins_allowed(allow_plugins):
        with reporting(quiet) as reporter:
            if seeds is not None:
                summary, good = run_seeds(
                    scene, overrides or [], out, fresh, threads, seeds=seeds, jobs=jobs, allow_plugins=allow_plugins,
                    reporter=reporter,
                )  # fmt: skip
            else:
                run = run_control(scene, overrides or [], out, fresh, threads, quiet, reporter=reporter)
        if seeds is None:
            draw_and_print_run(run)
            return
    for line in summary_lines(summary):
        typer.echo(line)
    if not good:
        raise typer.Exit(1)
