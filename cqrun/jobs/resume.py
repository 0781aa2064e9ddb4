"""`cqrun resume`: continue the job of a run directory."""

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
    """Continue the run in a directory; return the directory.

    Identification and learning continue from their checkpoint, and overrides can extend them. A simulation or a
    gradient check has no checkpoint and runs again.

    Raises:
        UsageError: there is no run, another process works on it, another engine made it, or the overrides do not fit.
        RunError: the run failed. Stopped: asked to stop.
    """
    talk = reporter or Silent()
    with RunDirectory.resume(Path(run_dir)) as run:
        if run.warning:
            talk.warn(run.warning)
        return job_of(run.path).resume(run, overrides, cores(threads), talk)
