"""What a tracker of experiments gets of a run: parameters, history, found values, tags and files."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.disk import require_ordinary
from cqrun.errors import UsageError
from cqrun.scene.document import read
from cqrun.store.history import ITERATION, SECONDS, read_history
from cqrun.store.provenance import versions
from cqrun.store.result import read_result, values_in
from cqrun.store.run import FINISHED, read_record, read_scene

FILES = ("result.json", "gradcheck.json", "run.json", "scene.yaml", "log.txt", "*.csv", "*.html", "figures/*.png")
"""Patterns of the files that are handed on; a trajectory is too large for a tracker."""

LARGEST = 50 * 1024**2
"""A larger file is left out [bytes]."""

MANY = 20
"""Of an unknown with more values, the mean and the range are handed on."""

LONGEST = 250
"""Characters of a parameter's value."""


@dataclass(frozen=True)
class Tracked:
    """A run for a tracker.

    Attributes:
        run: its folder.
        group: name of the scene, under which runs are compared.
        name: the hash that is the run's name.
        parameters: the scene with every default, key path -> text of the value.
        history: column -> values, one for each iteration; `iteration` has the steps.
        found: values of the unknowns and other results, by name.
        tags: job, status, engine, versions, commit.
        files: name inside the run -> file.
        ended: when it ended [s since 1970].
        seconds: how long it took [s].
    """

    run: Path
    group: str
    name: str
    parameters: Mapping[str, str]
    history: Mapping[str, Sequence[float]]
    found: Mapping[str, float]
    tags: Mapping[str, str]
    files: Mapping[str, Path]
    ended: float
    seconds: float

    def steps(self) -> Iterator[tuple[int, dict[str, float], float]]:
        """Yield each iteration, its finite numbers, and when it ended [s since 1970]."""
        began = self.ended - self.seconds
        names = [name for name in self.history if name not in (ITERATION, SECONDS)]
        for k, iteration in enumerate(self.history.get(ITERATION, [])):
            numbers = {name: self.history[name][k] for name in names if math.isfinite(self.history[name][k])}
            yield int(iteration), numbers, began + self.history[SECONDS][k]


def tracked(run: Path) -> Tracked:
    """Return what a tracker gets of a finished run.

    Raises:
        UsageError: there is no run, it is not finished, or one of its files is damaged.
    """
    record = read_record(run)
    if record["status"] not in FINISHED:
        raise UsageError(f"{run}: is not finished ({record['status']}); the command that started it continues it")
    folder = run.resolve()
    history = run / "history.csv"
    scene = read(read_scene(run, record)).data
    return Tracked(
        run=folder, group=folder.parent.name, name=folder.name,
        parameters=dict(_flat(scene)),
        history=read_history(history) if history.is_file() else {},
        found=dict(_found(run)), tags=_tags(record), files=dict(_files(run)),
        ended=(run / "run.json").stat().st_mtime, seconds=float(record["seconds"]),
    )  # fmt: skip


def when(seconds: float) -> str:
    """Return a time since 1970 as text, in UTC."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


def _flat(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the key paths of a scene with their values as text; a list of numbers is one value, an empty part none."""
    if value is None or value in ({}, []):
        return
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(inner, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list) and any(isinstance(entry, dict | list) for entry in value):
        for k, inner in enumerate(value):
            yield from _flat(inner, f"{path}.{k}")
    else:
        text = value if isinstance(value, str) else json.dumps(value, default=str)
        yield path, text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _found(run: Path) -> Iterator[tuple[str, float]]:
    """Yield the values of the unknowns, and the numbers that a result has at its top."""
    result = read_result(run)
    if result is None:
        return
    for name, number in result.model_dump().items():
        if isinstance(number, int | float) and not isinstance(number, bool) and math.isfinite(number):
            yield name, float(number)
    for path, value in values_in(result).items():
        numbers = np.atleast_1d(np.asarray(value, float)).ravel()
        if len(numbers) == 1:
            yield path, float(numbers[0])
        elif len(numbers) <= MANY:
            yield from ((f"{path}.{k}", float(number)) for k, number in enumerate(numbers))
        else:
            yield f"{path}.mean", float(numbers.mean())
            yield f"{path}.least", float(numbers.min())
            yield f"{path}.largest", float(numbers.max())


def _tags(record: Mapping[str, Any]) -> dict[str, str]:
    """Return what is known of how a run was made."""
    tags = {"job": record.get("job"), "status": record["status"], "engine": record.get("engine")}
    tags |= {f"version.{name}": version for name, version in (record.get("versions") or versions()).items()}
    git = record.get("git")
    if git:
        tags["commit"] = str(git.get("commit")) + (" with changes" if git.get("dirty") else "")
    if record.get("seed") is not None:
        tags["seed"] = str(record["seed"])
    return {name: str(text) for name, text in tags.items() if text}


def _files(run: Path) -> Iterator[tuple[str, Path]]:
    """Yield the files that are handed on, none of them a link."""
    for pattern in FILES:
        for path in sorted(run.glob(pattern)):
            require_ordinary(path)
            if os.path.getsize(path) <= LARGEST:  # noqa: PTH202
                yield path.relative_to(run).as_posix(), path
