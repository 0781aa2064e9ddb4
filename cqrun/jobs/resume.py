"""`cqrun resume`: go on with the job that a run directory is of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from cqrun.errors import UsageError
from cqrun.jobs.control import resume_control
from cqrun.jobs.gradcheck import resume_gradcheck
from cqrun.jobs.simulate import resume_simulate
from cqrun.jobs.sysid import resume_sysid
from cqrun.running.reporter import Reporter, Silent
from cqrun.running.threads import cores
from cqrun.store.run import RunDirectory

Resume = Callable[[RunDirectory, Sequence[str], int, Reporter], Path]
JOBS: dict[str, Resume] = {
    "sysid": resume_sysid,
    "control": resume_control,
    "codesign": resume_control,
    "simulate": resume_simulate,
    "gradcheck": resume_gradcheck,
}
"""Job, as run.json names it -> what continues it."""


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
    with RunDirectory.resume(Path(run_dir)) as run:
        job = str(run.record.get("job"))
        if job not in JOBS:
            raise UsageError(f"{run_dir}: a run of '{job}', which this version of cqrun does not know")
        return JOBS[job](run, overrides, cores(threads), reporter or Silent())
