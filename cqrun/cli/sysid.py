"""`cqrun sysid`: identify a scene's unknowns from data."""

from __future__ import annotations

from cqrun.cli.options import AllowPlugins, Fresh, Out, Overrides, Quiet, Resolution, Scene, Threads
from cqrun.store.places import results_in


def sysid(
    scene: Scene,
    overrides: Overrides = None,
    out: Out = None,
    fresh: Fresh = False,
    threads: Threads = None,
    resolution: Resolution = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Identify a scene's unknowns from its data, with confidence intervals.

    If every recording of the scene is held out, nothing is fitted: the recordings are predicted with its own values.

    Use the same command again to continue the run; if the run is finished, it says so.
    """
    from cqrun.cli.progress import working
    from cqrun.cli.results import draw_and_print_resolution, draw_and_print_run

    out = results_in(out, scene)
    with working(quiet, allow_plugins, f"reading {scene}") as reporter:
        from cqrun.jobs.studies.resolution import run_resolution
        from cqrun.jobs.sysid import SYSID

        if resolution is not None:
            study, succeeded = run_resolution(
                scene, overrides or [], out, job=SYSID, grids=resolution, fresh=fresh, threads=threads,
                reporter=reporter,
            )  # fmt: skip
        else:
            run = SYSID.run(scene, overrides or [], out, fresh=fresh, threads=threads, reporter=reporter)
    if resolution is not None:
        draw_and_print_resolution(study, succeeded, quiet, allow_plugins)
    else:
        draw_and_print_run(run, quiet, allow_plugins)
