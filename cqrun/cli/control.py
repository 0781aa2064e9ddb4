"""`cqrun control`: learn a controller for a body."""

from __future__ import annotations

from cqrun.cli.options import AllowPlugins, Fresh, Jobs, On, Out, Overrides, Quiet, Scene, Seeds, Threads
from cqrun.store.places import results_in


def control(
    scene: Scene,
    overrides: Overrides = None,
    out: Out = None,
    fresh: Fresh = False,
    threads: Threads = None,
    seeds: Seeds = None,
    jobs: Jobs = None,
    on: On = "processes",
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Learn a scene's controller by the gradient of its objective.

    Use the same command again to continue the run; if the run is finished, it says so.
    """
    from cqrun.cli.progress import working
    from cqrun.cli.results import draw_and_print_run, infeasible_shown, report_and_print_seeds, require_seeds_for_jobs

    require_seeds_for_jobs(seeds, jobs, on)
    with infeasible_shown(quiet, allow_plugins):
        out = results_in(out, scene)
        with working(quiet, allow_plugins, f"reading {scene}") as reporter:
            from cqrun.jobs.control import run_control
            from cqrun.jobs.studies.seeds import run_seeds

            if seeds is not None:
                summary, succeeded = run_seeds(
                    scene, overrides or [], out, seeds=seeds, jobs=jobs, on=on, fresh=fresh, threads=threads,
                    allow_plugins=allow_plugins, reporter=reporter,
                )  # fmt: skip
            else:
                run = run_control(scene, overrides or [], out, fresh=fresh, threads=threads, reporter=reporter)
        if seeds is None:
            draw_and_print_run(run, quiet, allow_plugins)
        else:
            report_and_print_seeds(summary, succeeded, quiet, allow_plugins)
