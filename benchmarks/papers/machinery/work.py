"""What takes time behind a figure: runs of cqrun, and measurements (measurement.py).

Each has a folder, and goes on where it stopped. A folder's `clock.json` says what was begun, by which engine, and how
long it has taken, pauses left out; `done.json` is written last, and adds the machine. Work whose command or scene has
changed is done anew, and what it was is put aside if it took long; that which wants more seeds goes on.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from benchmarks.papers.machinery.process import FAILED, ROOT, STOPPED, USAGE, when_free
from cqrun.errors import CqrunError
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import machine
from cqrun.running.threads import cores
from cqrun.store.atomic import make_directory, write_json
from cqrun.store.run import FINISHED, read_record

SCENES = ROOT / "scenes"
DONE, CLOCK = "done.json", "clock.json"
WORTH = 600.0
"""Seconds of work that are not thrown away unasked."""

TICK = 30.0
"""Seconds between two looks at the clock: a killed process has lost no more of its time than that."""

CLOCKS = threading.Lock()
"""Held while a clock is written."""

KILLED = "the same command goes on with it"
"""What cqrun says of a run that was killed, for want of memory as a rule: it failed, and is not finished."""


class WorkError(CqrunError):
    """Work that cannot go on, and what to do about it; other work can."""


@dataclass(frozen=True)
class Work(ABC):
    """Something that takes time.

    Attributes:
        name: its folder.
        minutes: of two cores that it takes, as measured: a run on one of them counts half of its time.
    """

    name: str
    minutes: float

    @property
    @abstractmethod
    def command(self) -> str:
        """What a reader would type."""

    @abstractmethod
    def fingerprint(self) -> str:
        """Return what its result depends on besides the engine, as hex digits."""

    @property
    @abstractmethod
    def is_alone(self) -> bool:
        """Say whether it wants the whole machine: other work would slow it, or what it measures."""

    @abstractmethod
    def go_on(self, folder: Path, seconds: float, jobs: int, share: float) -> bool:
        """Work for so long at most, with so much of the machine; say whether all is done."""

    def done(self, folder: Path) -> dict[str, Any] | None:
        """Return what `done.json` says, or None where the work is not done or is not this any more."""
        facts = _read(folder / DONE)
        return facts if facts.get("fingerprint") == self.fingerprint() else None

    def facts(self) -> dict[str, Any]:
        """Return what `done.json` tells besides how it was done."""
        return {"command": self.command}

    def remark(self, folder: Path) -> str:
        """Return what is to be said beside its time, if anything."""
        return ""

    def failures(self, folder: Path) -> list[str]:
        """Return what of it failed, in words."""
        return []

    def begun(self, folder: Path) -> bool:
        """Say whether a folder holds some of it, and not of what it was before it changed."""
        return bool(_read(folder / CLOCK).get("fingerprint") == self.fingerprint())

    def engine(self, folder: Path) -> str:
        """Return the hash of the engine that did it, or goes on with it."""
        return str((_read(folder / DONE) or _read(folder / CLOCK))["engine"])

    def start_over(self, folder: Path) -> None:
        """Empty the folder of what another engine has begun, if that is soon done again.

        Raises:
            WorkError: it is not.
        """
        with CLOCKS:
            clock = _read(folder / CLOCK)
            check_worth(folder, clock)
            shutil.rmtree(folder)
            make_directory(folder)
            write_json(folder / CLOCK, clock | {"engine": engine_hash(), "seconds": 0.0})

    def spent(self, folder: Path) -> float:
        """Return the seconds that were spent on it so far."""
        return float(_read(folder / CLOCK)["seconds"]) if self.begun(folder) else 0.0

    def left(self, folder: Path) -> float:
        """Return the minutes that it still takes, at least a tenth of all."""
        return max(0.1 * self.minutes, self.minutes - self.spent(folder) / 60.0)

    def do(self, folder: Path, seconds: float, jobs: int, share: float = 1.0) -> bool:
        """Do it, or go on with it; say whether it is done.

        Args:
            folder: holds it.
            seconds: that it has.
            jobs: runs side by side, where it has several.
            share: of the machine that is its own.
        """
        if not self.begun(folder):
            _clear(folder)
            make_directory(folder)
            fresh = {"fingerprint": self.fingerprint(), "engine": engine_hash(), "seconds": 0.0}
            write_json(folder / CLOCK, fresh)
        with _timed(folder, share):
            finished = self.go_on(folder, seconds, jobs, share)
        if finished:
            write_json(folder / DONE, _read(folder / CLOCK) | self.facts() | {"machine": machine()})
        return finished


def _clear(folder: Path) -> None:
    """Remove work that has changed since; put it aside if it took long."""
    clock = _read(folder / CLOCK)
    if clock.get("seconds", 0.0) > WORTH:
        aside = folder.with_name(f"{folder.name}.was-{clock['fingerprint']}-{clock['engine']}")
        print(f"    {folder.name} has changed: {span(clock['seconds'] / 60)} of what it was are in {aside}", flush=True)
        shutil.rmtree(aside, ignore_errors=True)
        folder.rename(aside)
    shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _timed(folder: Path, share: float) -> Iterator[None]:
    """Add the time of a block, of its share of the machine, to the clock of a folder, as it passes."""
    over, last = threading.Event(), time.monotonic()

    def count() -> None:
        nonlocal last
        with CLOCKS:
            clock, now = _read(folder / CLOCK), time.monotonic()
            write_json(folder / CLOCK, clock | {"seconds": clock["seconds"] + share * (now - last)})
            last = now

    def watch() -> None:
        while not over.wait(TICK):
            count()

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:  # asked to stop, too
        over.set()
        thread.join()
        count()


def span(minutes: float) -> str:
    """Return a time in words."""
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.1f} h"


def _read(file: Path) -> dict[str, Any]:
    try:
        return json.loads(file.read_text()) if file.exists() else {}
    except ValueError as error:
        raise WorkError(f"{file}: not JSON ({error}); delete {file.parent} to start that over") from None


@dataclass(frozen=True)
class Runs(Work):
    """One command of cqrun: a run, several seeds of it, or an ablation.

    Attributes:
        job: the command.
        scene: below scenes/, without suffix.
        overrides: of the scene.
        seeds: 0 for the scene's own alone.
        options: further words of the command.
        variants: of the scene that the options ask for, each with all seeds.
    """

    job: str
    scene: str
    overrides: tuple[str, ...] = ()
    seeds: int = 0
    options: tuple[str, ...] = ()
    variants: int = 1

    @property
    def path(self) -> Path:
        """The scene's file."""
        return SCENES / f"{self.scene}.yaml"

    @property
    def count(self) -> int:
        """How many runs it is."""
        return max(1, self.seeds) * self.variants

    @property
    def words(self) -> list[str]:
        """The command's words after the scene."""
        chosen = [word for override in self.overrides for word in ("-o", override)]
        return [*chosen, *(("--seeds", str(self.seeds)) if self.seeds else ()), *self.options]

    @property
    def command(self) -> str:
        """What a reader would type."""
        words = [f"'{word}'" if set(word) & set(" {}[]") else word for word in self.words]
        return " ".join(["cqrun", self.job, f"scenes/{self.scene}.yaml", *words])

    def fingerprint(self) -> str:
        """Return what its result depends on besides the engine, as hex digits."""
        # comments change nothing, and neither do more seeds, or what an override replaces
        replaced = {override.partition("=")[0] for override in self.overrides}
        scene = {key: value for key, value in yaml.safe_load(self.path.read_text()).items() if key not in replaced}
        whole = [self.job, self.scene, self.overrides, self.options, scene]
        files = sorted(_named(scene, self.path.parent))
        return digest(json.dumps(whole, sort_keys=True).encode(), *(file.read_bytes() for file in files))

    def done(self, folder: Path) -> dict[str, Any] | None:
        """Return what `done.json` says, or None where this is not done, or for fewer seeds."""
        facts = super().done(folder)
        return facts if facts is not None and facts["seeds"] >= self.seeds else None

    def facts(self) -> dict[str, Any]:
        """Return the command and its seeds."""
        return super().facts() | {"seeds": self.seeds}

    @property
    def is_alone(self) -> bool:
        """Say whether it has runs enough for the whole machine: seeds, or variants."""
        return self.seeds > 1 or "--ablate" in self.options

    def go_on(self, folder: Path, seconds: float, jobs: int, share: float) -> bool:
        """Run cqrun for so long at most; say whether it is finished."""
        command = [sys.executable, "-m", "cqrun", self.job, str(self.path), *self.words]
        command += ["--quiet", "--out", str(folder)]
        if self.seeds:
            command += ["--jobs", str(jobs if "--ablate" in self.options else min(jobs, self.seeds))]
        if share < 1.0:
            command += ["--threads", str(max(1, int(share * cores(None))))]
        end, begun, before = time.monotonic() + seconds, time.monotonic(), self.spent(folder)

        def tell() -> None:
            minutes = (before / share + time.monotonic() - begun) / 60.0
            left = span(self.left(folder) / share)
            print(f"    {self.name}: {self.progress(folder)}, {minutes:.0f} min; about {left} left", flush=True)

        code, said = when_free(self.name, command, end, tell)
        if code in (FAILED, USAGE) and "made by another engine" in said:
            self.start_over(folder)
            code, said = when_free(self.name, command, end, tell)
        if code not in (0, FAILED, STOPPED):
            raise WorkError(f"{self.name}: `{self.command}` ended with {code}\n{said}")
        if code == FAILED and KILLED in said:
            print(f"    {self.name}: {said.strip()}", flush=True)
            return False
        if code == FAILED and not self._ended(folder):
            raise WorkError(f"{self.name}: `{self.command}` ended with {code} before it was done\n{said}")
        return code != STOPPED

    def _ended(self, folder: Path) -> bool:
        """Say whether all its runs are there and came to an end: a full disk or a fault of ours is no result."""
        runs = self.runs(folder)
        return len(runs) >= self.count and all(read_record(run)["status"] in FINISHED for run in runs)

    def left(self, folder: Path) -> float:
        """Return the minutes that it still takes: at its own pace, once a fifth of several runs has ended."""
        try:
            ended = sum(read_record(run)["status"] in FINISHED for run in self.runs(folder))
        except CqrunError:  # a damaged record is told of by the run itself
            ended = 0
        if not self.begun(folder) or ended < max(2.0, self.count / 5):
            return super().left(folder)
        return self.spent(folder) / 60.0 * max(0, self.count - ended) / ended

    def progress(self, folder: Path) -> str:
        """Return how far its runs are."""
        histories = [file.read_text().count("\n") - 2 for file in folder.rglob("history.csv")]
        runs = f"{len(self.runs(folder))} run{'s' if len(self.runs(folder)) != 1 else ''} begun"
        return f"{runs}, {sum(max(0, count) for count in histories)} iterations" if histories else runs

    def failures(self, folder: Path) -> list[str]:
        """Return why runs of it failed, which is a result too."""
        records = [read_record(run) for run in self.runs(folder)]
        return [str(record["reason"]) for record in records if record["status"] == "failed"]

    def runs(self, folder: Path) -> list[Path]:
        """Return its run directories."""
        return sorted(path.parent for path in (folder / self.path.stem).glob("*/run.json"))


def check_worth(path: Path, clock: Mapping[str, Any]) -> None:
    """Raise if what another engine has begun took too long to be thrown away unasked.

    Raises:
        WorkError: it did.
    """
    if clock["seconds"] > WORTH:
        raise WorkError(
            f"{path}: {clock['seconds'] / 60:.0f} minutes of work by engine {clock['engine']}, and this is "
            f"{engine_hash()}: go on with the commit that has that engine, or delete it to start over"
        )


def _named(value: object, base: Path) -> Iterator[Path]:
    """Yield the files beside a scene that it names: shapes, images."""
    if isinstance(value, str) and Path(value).suffix and (base / value).is_file():
        yield base / value
    for each in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _named(each, base)


def digest(*parts: bytes) -> str:
    """Return a hash of what work depends on, as hex digits."""
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:12]


Found = Mapping[str, Path]
"""The folders of work that is done, by its name."""
