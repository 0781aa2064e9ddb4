"""The number of threads of a job, and checks of the arguments that Python callers pass."""

from __future__ import annotations

import os
from collections.abc import Sequence
from numbers import Integral
from pathlib import Path
from typing import Any

from cqrun.errors import UsageError
from cqrun.explain import shown

MOST = "CQRUN_MOST_THREADS"
"""Variable with the largest number of threads if none is given; the command line sets it from NUMBA_NUM_THREADS."""


def cores(threads: int | None) -> int:
    """Return how many threads to use: the given number, or all cores that this process may run on, within MOST."""
    if threads is not None:
        return threads
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    most = os.environ.get(MOST, "")
    return min(usable, max(1, int(most))) if most.isdecimal() else usable


def checked_threads(caller: str, scene: Any, overrides: Any, threads: Any) -> int | None:
    """Return the number of threads as an int; raise a UsageError if an argument of `caller` is not valid."""
    if not isinstance(scene, Path | str | dict):
        raise UsageError(f"{caller}: the scene must be a file's path, YAML text or a dict, is {shown(scene)}")
    if isinstance(overrides, str):
        raise UsageError(f"{caller}: overrides are a list: [{overrides!r}]")
    if not isinstance(overrides, Sequence) or not all(isinstance(text, str) for text in overrides):
        raise UsageError(f"{caller}: overrides are a list of texts 'key.path=value', not {shown(overrides)}")
    if threads is not None and (isinstance(threads, bool) or not isinstance(threads, Integral) or threads < 1):
        raise UsageError(f"{caller}: threads must be a whole number from 1 on, is {shown(threads)}")
    return None if threads is None else int(threads)
