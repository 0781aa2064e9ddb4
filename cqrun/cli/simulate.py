"""`cqrun simulate`: run a scene forward."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Fresh, Out, Overrides, Quiet, Resolution, Threads
from cqrun.store.places import results_in


def simulate(
    scene: Annotated[
        Path,
        typer.Argument(metavar="SCENE|RUN", help="Scene file (YAML), or a run to replay.", show_default=False),
    ],
    overrides: Overrides = None,
    out: Out = None,
    fresh: Fresh = False,
    threads: Threads = None,
    controller: Annotated[
        Path | None, typer.Option("--controller", metavar="FILE", help="Trained controller to use (controller.npz).")
    ] = None,
    resolution: Resolution = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Run a scene forward and write its trajectory (HDF5, which ParaView can read).

    Instead of a scene you can give a run to replay: one of `cqrun control` or `codesign`, with -o for example for a
    longer time or another goal, or one of `cqrun sysid`, with the values that it identified.
    """
    from cqrun.cli.progress import working
    from cqrun.cli.results import draw_and_print_resolution, draw_and_print_run
    from cqrun.errors import UsageError

    if resolution is not None and controller is not None:
        raise UsageError("--resolution: runs a scene with its own controller, not one from a file: remove --controller")

    out = results_in(out, scene)
    with working(quiet, allow_plugins, f"reading {scene}") as reporter:
        from cqrun.jobs.simulate import SIMULATE, run_simulate
        from cqrun.jobs.studies.resolution import run_resolution

        if resolution is not None:
            study, succeeded = run_resolution(
                scene, overrides or [], out, job=SIMULATE, grids=resolution, fresh=fresh, threads=threads,
                reporter=reporter,
            )  # fmt: skip
        else:
            run = run_simulate(
                scene,
                overrides or [],
                out,
                fresh=fresh,
                threads=threads,
                controller=controller,
                reporter=reporter,
            )
    if resolution is not None:
        draw_and_print_resolution(study, succeeded, quiet, allow_plugins)
    else:
        draw_and_print_run(run, quiet, allow_plugins)
