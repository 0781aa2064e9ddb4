"""All jobs by their names."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.jobs.control import CODESIGN, CONTROL
from cqrun.jobs.gradcheck import GRADCHECK
from cqrun.jobs.job import Job
from cqrun.jobs.rest import REST
from cqrun.jobs.simulate import SIMULATE
from cqrun.jobs.sysid import SYSID
from cqrun.store.run import read_record

JOBS: Mapping[str, Job[Any, Any]] = MappingProxyType(
    {job.name: job for job in (SYSID, CONTROL, CODESIGN, SIMULATE, REST, GRADCHECK)}
)
"""Job by the name that run.json and a scene have."""


def job_of(run: Path) -> Job[Any, Any]:
    """Return the job of the run in a directory.

    Raises:
        UsageError: there is no run, or its job is unknown to this version.
    """
    name = str(read_record(run).get("job"))
    if name not in JOBS:
        raise UsageError(
            f"{run}: a run of '{name}', which this version of cqrun does not know; it knows {listed(JOBS)}"
        )
    return JOBS[name]


def report_lines(run: Path) -> list[str]:
    """Return the result of a run as lines for a terminal, or its status if it has no result yet.

    Raises:
        UsageError: there is no run, or its result cannot be read.
    """
    return job_of(run).report(run)
