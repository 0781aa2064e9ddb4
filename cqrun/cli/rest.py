"""`cqrun rest`: find where a scene comes to rest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Fresh, Out, Overrides, Quiet, Resolution, Threads
from cqrun.store.places import results_in


def rest(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (YAML).", show_default=False)],
    overrides: Overrides = None,
    out: Out = None,
    fresh: Fresh = False,
    threads: Threads = None,
    resolution: Resolution = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Find where a scene comes to rest under its loads and activations, without simulating the way there.

    With a section `path`, find one equilibrium after the other, such as a curve of force against displacement.
    """
    from cqrun.cli.progress import working
    from cqrun.cli.results import draw_and_print_resolution, draw_and_print_run

    out = results_in(out, scene)
    with working(quiet, allow_plugins, f"reading {scene}") as reporter:
        from cqrun.jobs.rest import REST
        from cqrun.jobs.studies.resolution import run_resolution

        if resolution is not None:
            study, succeeded = run_resolution(
                scene,
                overrides or [],
                out,
                job=REST,
                grids=resolution,
                fresh=fresh,
                threads=threads,
                reporter=reporter,
            )
        else:
            run = REST.run(scene, overrides or [], out, fresh=fresh, threads=threads, reporter=reporter)
    if resolution is not None:
        draw_and_print_resolution(study, succeeded, quiet, allow_plugins)
    else:
        draw_and_print_run(run, quiet, allow_plugins)
