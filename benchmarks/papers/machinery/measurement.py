"""A task that is a Python function, where no command of cqrun measures what a figure shows."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.papers.machinery.task import Task, digest, numbers_of
from cqrun.fingerprint import engine_hash
from cqrun.running.cluster import PROCESSES
from cqrun.store.atomic import write_json


@dataclass(frozen=True)
class Measurement(Task):
    """A function that measures something.

    Source code is not in its fingerprint: a change of code that makes it another measurement has to change a setting.
    """

    measure: Callable[
        [Path, float], bool
    ]  # (folder for its results, time.monotonic deadline) -> whether it is finished
    typed: str  # the command that a reader would type
    files: tuple[Path, ...] = ()  # scenes and data that it reads; a change makes it another measurement
    settings: tuple[str, ...] = ()  # words of which the same is true
    seeds: int = 1
    exclusive: bool = False

    @property
    def command(self) -> str:
        """The command that a reader would type."""
        return self.typed

    def fingerprint(self) -> str:
        """Return a hash of the command, the settings and the files."""
        return digest(*(word.encode() for word in (self.typed, *self.settings)), *map(_content, self.files))

    def advance(self, folder: Path, seconds: float, jobs: int, share: float, on: str = PROCESSES) -> bool:
        """Measure for a limited time; return whether it is finished. Results of two engines are not mixed."""
        if self.engine(folder) != engine_hash():
            self.start_over(folder)
        return self.measure(folder, time.monotonic() + seconds)


def _content(path: Path) -> bytes:
    """Return the content of a file; of a scene without comments and optimizer, which no measurement uses."""
    if path.suffix == ".yaml":
        scene = {key: value for key, value in numbers_of(path).items() if key != "optimizer"}
        return json.dumps(scene, sort_keys=True).encode()
    return path.read_bytes()


Row = Mapping[str, object]


def measure_rows(folder: Path, deadline: float, rows: Mapping[str, Callable[[], Row | None]]) -> bool:
    """Measure the rows that are missing in a folder, each into a file of its own.

    Args:
        rows: name -> the function that measures the row, or returns None if the time is over.

    Returns:
        Whether all rows are there.
    """
    for name, measure in rows.items():
        file = folder / f"row-{name}.json"
        if file.exists():
            continue
        if time.monotonic() > deadline or (row := measure()) is None:
            return False
        write_json(file, row)
    return True


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Return the rows that `measure_rows` has written, by name."""
    return [json.loads(file.read_text()) for file in sorted(folder.glob("row-*.json"))]
