"""Something that takes time: runs of cqrun (runs.py), or a measurement (measurement.py).

A task has a folder, and continues there after it was stopped. `clock.json` in it says which task was begun, with which
engine, and how long it has run. `done.json` is written last, and adds the machine. A task whose command or scene
has changed starts over, and its old folder is set aside if it took long. A task that needs more seeds continues.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cqrun.errors import CqrunError
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import machine
from cqrun.running.cluster import PROCESSES
from cqrun.store.atomic import make_directory, write_json

DONE, CLOCK, REMARK = "done.json", "clock.json", "remark.json"
"""In a task's folder. The remark is text that the page shows beside the time."""

TOO_LONG_TO_LOSE = 600.0
"""A task that ran for more seconds than this is not deleted without asking."""

CLOCK_EVERY = 30.0
"""Seconds between two entries in the clock. A killed process loses no more of its time than this."""

CLOCK_LOCK = threading.Lock()
"""Held while a clock is written."""


class TaskError(CqrunError):
    """A task cannot continue; the message says what to do. Other tasks can."""


@dataclass(frozen=True)
class Task(ABC):
    """Something that takes time."""

    name: str  # of its folder
    minutes: float  # that two cores take, as measured; a run on one of two cores counts half of its time

    @property
    @abstractmethod
    def command(self) -> str:
        """The command that a reader would type."""

    @property
    def seeds(self) -> int:
        """How many seeds it has. One that is done continues if it needs more."""
        return 1

    @property
    @abstractmethod
    def exclusive(self) -> bool:
        """Whether it needs the whole machine, because other tasks would slow it or disturb what it measures."""

    @abstractmethod
    def fingerprint(self) -> str:
        """Return a hash of what its result depends on, except the engine and the number of seeds."""

    @abstractmethod
    def advance(self, folder: Path, seconds: float, jobs: int, share: float, on: str = PROCESSES) -> bool:
        """Work for a limited time with a share of the machine; return whether it is finished."""

    def failures(self, folder: Path) -> list[str]:
        """Return why parts of it failed."""
        return []

    def remark(self, folder: Path) -> str:
        """Return the text that the page shows beside its time, or an empty one."""
        return str(_read(folder / REMARK) or "")

    def begun(self, folder: Path) -> bool:
        """Return whether a folder holds a part of this task, as it is today."""
        return bool(_read(folder / CLOCK).get("fingerprint") == self.fingerprint())

    def done(self, folder: Path) -> dict[str, Any] | None:
        """Return the content of `done.json`, or None if the task is not done, or was another task when it was."""
        facts = _read(folder / DONE)
        complete = facts.get("fingerprint") == self.fingerprint() and facts.get("seeds", self.seeds) >= self.seeds
        return facts if complete else None

    def engine(self, folder: Path) -> str:
        """Return the hash of the engine that did the task, or has to continue it."""
        return str((_read(folder / DONE) or _read(folder / CLOCK))["engine"])

    def spent(self, folder: Path) -> float:
        """Return the seconds that the task has taken so far."""
        return float(_read(folder / CLOCK)["seconds"]) if self.begun(folder) else 0.0

    def left(self, folder: Path) -> float:
        """Return an estimate of the minutes that are left, at least a tenth of all."""
        return max(0.1 * self.minutes, self.minutes - self.spent(folder) / 60.0)

    def do(self, folder: Path, seconds: float, jobs: int, share: float = 1.0, on: str = PROCESSES) -> bool:
        """Begin or continue the task; return whether it is done.

        Args:
            folder: of the task.
            seconds: how long it may take.
            jobs: runs side by side, if it has several.
            share: of the machine that the task has for itself.
            on: where it makes its runs, if it has several: here, or a place as of `cqrun control --on`.
        """
        if not self.begun(folder):
            _clear(folder)
            self._begin(folder)
        with _timed(folder, share):
            finished = self.advance(folder, seconds, jobs, share, on)
        if finished:
            facts = {"command": self.command, "seeds": self.seeds, "machine": machine()}
            write_json(folder / DONE, _read(folder / CLOCK) | facts)
        return finished

    def start_over(self, folder: Path) -> None:
        """Empty the folder of a task that another engine has begun.

        Raises:
            TaskError: it took too long to be deleted without asking.
        """
        with CLOCK_LOCK:
            require_short(folder, _read(folder / CLOCK))
            shutil.rmtree(folder)
            self._begin(folder)

    def _begin(self, folder: Path) -> None:
        make_directory(folder)
        clock = {"fingerprint": self.fingerprint(), "engine": engine_hash(), "seconds": 0.0}
        write_json(folder / CLOCK, clock)


def require_short(path: Path, clock: dict[str, Any]) -> None:
    """Raise an error if a task that another engine has begun took too long to be deleted without asking.

    Raises:
        TaskError: it took so long, as its clock says.
    """
    if clock["seconds"] > TOO_LONG_TO_LOSE:
        raise TaskError(
            f"{path}: {clock['seconds'] / 60:.0f} minutes of work by engine {clock['engine']}, and this is engine "
            f"{engine_hash()}: check out the commit that has that engine to continue, or delete it to start over"
        )


def duration(minutes: float) -> str:
    """Return a time in words."""
    if minutes < 1 / 60:
        return "under a second"
    if minutes < 2:
        return f"{60 * minutes:.0f} s"
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.1f} h"


def digest(*parts: bytes) -> str:
    """Return a hash of bytes, 12 hex digits."""
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:12]


def numbers_of(scene: Path) -> dict[str, Any]:
    """Return the content of a scene of the papers, of which fingerprints are made.

    Their frame is left out: it is `updated`, which had no name when most figures were made.
    """
    content: dict[str, Any] = yaml.safe_load(scene.read_text())
    if content.get("world", {}).get("frame") == "updated":
        content["world"] = {key: value for key, value in content["world"].items() if key != "frame"}
    return content


def _clear(folder: Path) -> None:
    """Remove the folder of a task that has changed; set it aside if it took long."""
    clock = _read(folder / CLOCK)
    if clock.get("seconds", 0.0) > TOO_LONG_TO_LOSE:
        aside = folder.with_name(f"{folder.name}.was-{clock['fingerprint']}-{clock['engine']}")
        time_spent = duration(clock["seconds"] / 60)
        print(f"    {folder.name} has changed: its earlier results ({time_spent}) are now in {aside}", flush=True)
        shutil.rmtree(aside, ignore_errors=True)
        folder.rename(aside)
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _timed(folder: Path, share: float) -> Iterator[None]:
    """Add the time of a block, times its share of the machine, to the clock of a folder, while it runs."""
    over, last = threading.Event(), time.monotonic()

    def count() -> None:
        nonlocal last
        with CLOCK_LOCK:
            clock, now = _read(folder / CLOCK), time.monotonic()
            write_json(folder / CLOCK, clock | {"seconds": clock["seconds"] + share * (now - last)})
            last = now

    def watch() -> None:
        while not over.wait(CLOCK_EVERY):
            count()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:  # also if it is asked to stop
        over.set()
        thread.join()
        count()


def _read(file: Path) -> Any:
    try:
        return json.loads(file.read_text()) if file.exists() else {}
    except ValueError as error:
        raise TaskError(f"{file}: damaged ({error}); delete {file.parent} to start that task over") from None
