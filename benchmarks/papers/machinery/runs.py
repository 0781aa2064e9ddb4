"""A task that is one command of cqrun: a run, several seeds of it, or an ablation."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.papers.machinery.process import FAILED, ROOT, STOPPED, USAGE, run_command
from benchmarks.papers.machinery.task import Task, TaskError, digest, duration, numbers_of
from cqrun.errors import CqrunError
from cqrun.running.cluster import PROCESSES
from cqrun.running.threads import cores
from cqrun.store.run import FINISHED, read_record

SCENES = ROOT / "scenes"

KILLED = "the same command goes on with it"
"""What cqrun says of a run that was killed, usually because memory ran out. It failed, but it can continue."""

OTHER_ENGINE = "made by another engine"
"""What cqrun says of an unfinished run of another engine."""


@dataclass(frozen=True)
class Runs(Task):
    """One command of cqrun."""

    job: str
    scene: str  # path below scenes/, without suffix
    overrides: tuple[str, ...] = ()
    seeds: int = 0  # 0 for the scene's own seed only
    options: tuple[str, ...] = ()  # further words of the command
    variants: int = 1  # how many variants of the scene the options ask for, each with all seeds

    @property
    def path(self) -> Path:
        """The scene's file."""
        return SCENES / f"{self.scene}.yaml"

    @property
    def count(self) -> int:
        """How many runs it has."""
        return max(1, self.seeds) * self.variants

    @property
    def words(self) -> list[str]:
        """The command's words after the scene."""
        overrides = [word for override in self.overrides for word in ("-o", override)]
        return [*overrides, *(("--seeds", str(self.seeds)) if self.seeds else ()), *self.options]

    @property
    def command(self) -> str:
        """The command that a reader would type."""
        words = [f"'{word}'" if set(word) & set(" {}[]") else word for word in self.words]
        return " ".join(["cqrun", self.job, f"scenes/{self.scene}.yaml", *words])

    @property
    def exclusive(self) -> bool:
        """Whether it has enough runs for the whole machine: seeds, or variants."""
        return self.seeds > 1 or "--ablate" in self.options

    def fingerprint(self) -> str:
        """Return a hash of the command and the scene, without comments and without what an override replaces."""
        replaced = {override.partition("=")[0] for override in self.overrides}
        scene = {key: value for key, value in numbers_of(self.path).items() if key not in replaced}
        content = [self.job, self.scene, self.overrides, self.options, scene]
        files = sorted(_files_in(scene, self.path.parent))
        return digest(json.dumps(content, sort_keys=True).encode(), *(file.read_bytes() for file in files))

    def advance(self, folder: Path, seconds: float, jobs: int, share: float, on: str = PROCESSES) -> bool:
        """Run cqrun for a limited time; return whether it is finished."""
        command = [sys.executable, "-m", "cqrun", self.job, str(self.path), *self.words]
        command += ["--quiet", "--out", str(folder)]
        if self.seeds:
            command += ["--jobs", str(jobs if "--ablate" in self.options else min(jobs, self.seeds))]
            command += ["--on", on]
        if share < 1.0:
            command += ["--threads", str(max(1, int(share * cores(None))))]
        start, spent = time.monotonic(), self.spent(folder)

        def report() -> None:
            so_far = duration((spent / share + time.monotonic() - start) / 60.0)
            left = duration(self.left(folder) / share)
            print(f"    {self.name}: {self.progress(folder)}, {so_far}; about {left} left", flush=True)

        ended = run_command(self.name, command, start + seconds, report)
        if ended.status in (FAILED, USAGE) and OTHER_ENGINE in ended.output:
            self.start_over(folder)
            ended = run_command(self.name, command, start + seconds, report)
        if ended.status == FAILED and KILLED in ended.output:
            print(f"    {self.name}: {ended.output.strip()}", flush=True)
            return False
        if ended.status not in (0, FAILED, STOPPED):
            raise TaskError(f"{self.name}: `{self.command}` ended with {ended.status}\n{ended.output}")
        runs = self._ended(folder)
        if ended.status == FAILED and not (len(runs) >= self.count and all(runs)):  # a full disk, or our own fault
            raise TaskError(f"{self.name}: `{self.command}` ended with {FAILED} before it was done\n{ended.output}")
        return ended.status != STOPPED

    def runs(self, folder: Path) -> list[Path]:
        """Return its run directories."""
        return sorted(path.parent for path in (folder / self.path.stem).glob("*/run.json"))

    def _ended(self, folder: Path) -> list[bool]:
        """Return for each of its runs whether it has ended, well or not."""
        return [read_record(run)["status"] in FINISHED for run in self.runs(folder)]

    def left(self, folder: Path) -> float:
        """Return an estimate of the minutes that are left, from its own pace once a fifth of its runs have ended."""
        try:
            ended = sum(self._ended(folder))
        except CqrunError:  # a damaged record: the run itself reports it
            ended = 0
        if not self.begun(folder) or ended < max(2.0, self.count / 5):
            return super().left(folder)
        return self.spent(folder) / 60.0 * max(0, self.count - ended) / ended

    def progress(self, folder: Path) -> str:
        """Return how far its runs are."""
        count = len(self.runs(folder))
        iterations = [file.read_text().count("\n") - 2 for file in folder.rglob("history.csv")]
        runs = f"{count} run{'s' if count != 1 else ''} begun"
        return f"{runs}, {sum(max(0, number) for number in iterations)} iterations" if iterations else runs

    def failures(self, folder: Path) -> list[str]:
        """Return why runs of it failed. A failed run is a result, too."""
        records = [read_record(run) for run in self.runs(folder)]
        return [str(record["reason"]) for record in records if record["status"] == "failed"]


def _files_in(value: object, base: Path) -> Iterator[Path]:
    """Yield the files that a scene names, such as shapes and images."""
    if isinstance(value, str) and Path(value).suffix and (base / value).is_file():
        yield base / value
    for each in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        yield from _files_in(each, base)
