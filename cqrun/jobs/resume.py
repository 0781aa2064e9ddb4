"""`cqrun resume`: go on with the job that a run directory is of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cqrun.jobs.table import job_of
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.threads import cores
from cqrun.store.run import RunDirectory


def run_resume(
    run_dir: Path | str, overrides: Sequence[str], *, threads: int | None = None, reporter: Reporter | None = None
) -> Path:
    """Continue the run in a directory; return it.

    An identification goes on where it was, or is extended by overrides; a simulation and a gradient check, which
    keep nothing to go on from, run again.

    Raises:
        UsageError: it is no run, another process or engine holds it, or the overrides do not fit.
        RunError: the run failed. Stopped: it was asked to stop.
    """
    talk = reporter or Silent()
    with RunDirectory.resume(Path(run_dir)) as run:
        if run.warning:
            talk.warn(run.warning)
        return job_of(run.path).resume(run, overrides, cores(threads), talk)
