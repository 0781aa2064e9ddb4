"""`cqrun bench`: measure the time of each pass."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Overrides, Quiet, Threads
from cqrun.cli.terminal import echo


def bench(
    scene: Annotated[Path | None, typer.Argument(metavar="[SCENE]", help="Scene whose substeps are measured.")] = None,
    overrides: Overrides = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", metavar="FILE", help="Also write the results as JSON, with facts about the machine."),
    ] = None,
    threads: Threads = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes only, to check that it runs.")] = False,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Measure the time of each pass, forward and backward, in ns per particle and substep.

    Without SCENE it measures falling blocks of several sizes. With SCENE it measures the scene's substeps, from the
    middle of its rollout on, and the cost of a gradient.
    """
    from cqrun.cli.progress import working
    from cqrun.errors import UsageError

    if scene is None:
        if overrides or allow_plugins:
            raise UsageError("-o and --allow-plugins are for a scene: `cqrun bench SCENE -o KEY=VALUE`")
        from cqrun.jobs.bench import run_bench

        run_bench(output, threads=threads, quick=quick)
        return
    if quick:
        raise UsageError("--quick is for blocks; make a scene small with -o")
    with working(quiet, allow_plugins, f"reading {scene}") as reporter:
        from cqrun.jobs.bench import run_bench_scene

        lines = run_bench_scene(scene, overrides or (), output, threads=threads, talk=reporter)
    for line in lines:
        echo(line)
