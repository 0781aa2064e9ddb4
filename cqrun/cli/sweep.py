"""`cqrun sweep`: run a scene at many points, and make one table of what was asked and found."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import AllowPlugins, Fresh, Jobs, On, Out, Overrides, Quiet, Threads
from cqrun.store.places import results_in

Axes = Annotated[
    list[str] | None,
    typer.Option(
        "-s",
        "--set",
        metavar="KEY=VALUES",
        help="Values of a key (repeatable): a,b,c; or FROM:TO:COUNT; or FROM:TO:log:COUNT; or FROM:TO for --samples.",
    ),
]
Samples = Annotated[
    int | None, typer.Option("--samples", metavar="N", help="Number of samples of the ranges without a count.")
]
Random = Annotated[bool, typer.Option("--random", help="Draw samples independently, not evenly as a Latin hypercube.")]
Draw = Annotated[int, typer.Option("--draw", min=0, metavar="K", help="Seed of the samples.")]
OfSeeds = Annotated[
    int | None, typer.Option("--seeds", metavar="N", help="Also run every point with the scene's seeds 0 to N - 1.")
]
JobName = Annotated[
    str | None,
    typer.Option("--job", metavar="JOB", help="Job of the runs; the scene's own if not given, or simulate."),
]
Show = Annotated[
    list[str] | None,
    typer.Option("--show", metavar="NUMBER", help="Number that the picture and the table show (repeatable)."),
]


def sweep(
    scene: Annotated[
        Path,
        typer.Argument(metavar="SCENE|RUN", help="Scene file (YAML), or a run of a scene.", show_default=False),
    ],
    axes: Axes = None,
    samples: Samples = None,
    random: Random = False,
    draw: Draw = 0,
    seeds: OfSeeds = None,
    job: JobName = None,
    jobs: Jobs = None,
    on: On = "processes",
    show: Show = None,
    overrides: Overrides = None,
    out: Out = None,
    fresh: Fresh = False,
    threads: Threads = None,
    allow_plugins: AllowPlugins = False,
    quiet: Quiet = False,
) -> None:
    """Run a scene with many values of some of its keys, several at once, and make a table of what was found.

    All combinations of the values are run. Use the same command again to continue, or a wider one to add points.
    Instead of a scene you can give a run: its scene is run by the same command. With --job simulate, every run replays
    the controller or the values that the run has found.
    """
    from cqrun.cli.progress import working
    from cqrun.cli.results import draw_and_print_sweep

    out = results_in(out, scene)
    with working(quiet, allow_plugins, f"reading {scene}") as reporter:
        from cqrun.jobs.studies.sweep import SweepOptions, run_sweep

        options = SweepOptions(
            axes or [], samples, "random" if random else "latin", draw, seeds=seeds, job=job, jobs=jobs, on=on
        )
        table, succeeded = run_sweep(
            scene, overrides or [], out, options, fresh=fresh, threads=threads, allow_plugins=allow_plugins,
            reporter=reporter,
        )  # fmt: skip
    draw_and_print_sweep(table, succeeded, quiet, allow_plugins, show or [])
