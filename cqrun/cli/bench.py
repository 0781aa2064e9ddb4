"""`cqrun bench`: how long each pass takes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cqrun.cli.options import Threads


def bench(
    output: Annotated[
        Path | None,
        typer.Option("--output", metavar="FILE", help="Also write JSON with the machine's facts."),
    ] = None,
    threads: Threads = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes only: does it run, not how fast.")] = False,
) -> None:
    """Measure ns per particle and substep of each pass, forward and backward."""
    from cqrun.jobs.bench import run_bench

    run_bench(output, threads=threads, quick=quick)
