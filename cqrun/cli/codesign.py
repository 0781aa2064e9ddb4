"""`cqrun codesign`: optimise a body's design together with its controller."""

from __future__ import annotations

from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Fresh, Jobs, On, Out, Overrides, Quiet, Scene, Seeds, Threads
from cqrun.store.places import results_in


def codesign(
    scene: Scene,
    overrides: Overrides = None,
    out: Out = None,
    fresh: Fresh = False,
    threads: Threads = None,
    seeds: Seeds = None,
    jobs: Jobs = None,
    on: On = "processes",
    ablate: Annotated[
        bool,
        typer.Option("--ablate", help="Compare variants: only the controller, with each kind of unknown, with all."),
    ] = False,
    rates: Annotated[
        list[float] | None,
        typer.Option("--rate", metavar="X", help="Learning rate to try with every variant (repeatable)."),
    ] = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Optimise a scene's design and its controller together, under its constraints.

    Use the same command again to continue the run; if the run is finished, it says so.
    """
    from cqrun.cli.progress import working
    from cqrun.cli.results import (
        draw_and_print_ablation,
        draw_and_print_run,
        infeasible_shown,
        report_and_print_seeds,
        require_seeds_for_jobs,
    )
    from cqrun.errors import UsageError

    if rates and not ablate:
        raise UsageError("--rate: is only for variants: add --ablate, or use -o optimizer...learning_rate=X")
    if not ablate:
        require_seeds_for_jobs(seeds, jobs, on)
    with infeasible_shown(quiet, allow_plugins):
        out = results_in(out, scene)
        with working(quiet, allow_plugins, f"reading {scene}") as reporter:
            from cqrun.jobs.control import CODESIGN, run_codesign
            from cqrun.jobs.studies.ablation import run_ablation
            from cqrun.jobs.studies.seeds import run_seeds

            if ablate:
                comparison, succeeded = run_ablation(
                    scene, overrides or [], out, seeds=1 if seeds is None else seeds, rates=rates or [], jobs=jobs,
                    on=on, fresh=fresh, threads=threads, allow_plugins=allow_plugins, reporter=reporter,
                )  # fmt: skip
            elif seeds is not None:
                summary, succeeded = run_seeds(
                    scene, overrides or [], out, seeds=seeds, job=CODESIGN, jobs=jobs, on=on, fresh=fresh,
                    threads=threads, allow_plugins=allow_plugins, reporter=reporter,
                )  # fmt: skip
            else:
                run = run_codesign(scene, overrides or [], out, fresh=fresh, threads=threads, reporter=reporter)
        if ablate:
            draw_and_print_ablation(comparison, succeeded, quiet, allow_plugins)
        elif seeds is not None:
            report_and_print_seeds(summary, succeeded, quiet, allow_plugins)
        else:
            draw_and_print_run(run, quiet, allow_plugins)
