"""How many threads a job uses, and whether those asked for from Python can be used."""

from __future__ import annotations

import os
from collections.abc import Sequence
from numbers import Integral
from pathlib import Path
from typing import Any

from cqrun.errors import UsageError
from cqrun.explain import shown


def cores(threads: int | None) -> int:
    """Return how many threads to use: those asked for, or every core this process may run on."""
    if threads is not None:
        return threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def checked_threads(caller: str, scene: Any, overrides: Any, threads: Any) -> int | None:
    """Return the number of threads as Python's own; UsageError for an argument of a caller that cannot be."""
    if not isinstance(scene, Path | str | dict):
        raise UsageError(f"{caller}: the scene must be a file's path, YAML text or a dict, is {shown(scene)}")
    if isinstance(overrides, str):
        raise UsageError(f"{caller}: overrides are a list: [{overrides!r}]")
    if not isinstance(overrides, Sequence) or not all(isinstance(text, str) for text in overrides):
        raise UsageError(f"{caller}: overrides are a list of texts 'key.path=value', not {shown(overrides)}")
    if threads is not None and (isinstance(threads, bool) or not isinstance(threads, Integral) or threads < 1):
        raise UsageError(f"{caller}: threads must be a whole number from 1 on, is {shown(threads)}")
    return None if threads is None else int(threads)
