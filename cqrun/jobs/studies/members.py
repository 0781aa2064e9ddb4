"""The runs of a study: the command of each, which of them are there already, and where the others are made.

Every run is a process of its own (running/fleet.py), here or on a cluster (running/cluster.py). It can be stopped and
resumed like any other run.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cqrun.fingerprint import engine_hash
from cqrun.jobs.job import Job
from cqrun.running.cluster import PROCESSES, Parcel, require_place, run_on_cluster
from cqrun.running.fleet import Member, run_fleet
from cqrun.running.reporter import Reporter
from cqrun.running.runs import data_files, part_files
from cqrun.scene.schema import Scene
from cqrun.store.folder import RECORD, REPORT
from cqrun.store.result import RESULT
from cqrun.store.run import FINISHED, read_record

INFEASIBLE = "infeasible"
"""Status of a run that does not meet its constraints."""

FRESH = "--fresh"


def command_of(job: str, source: Path, out: Path, threads: int, fresh: bool, allow_plugins: bool) -> list[str]:
    """Return the command of one run, without its overrides; -P: it imports nothing from the current folder."""
    words = [sys.executable, "-P", "-m", "cqrun", job, str(source), "--quiet", "--out", str(out)]
    words += ["--threads", str(max(1, threads))]
    return words + [FRESH] * fresh + ["--allow-plugins"] * allow_plugins


def has_ended(member: Member) -> bool:
    """Return whether a run has a result, which may violate its constraints."""
    return member.failure is None or (
        (member.run / RESULT).exists() and read_record(member.run)["status"] == INFEASIBLE
    )


def unfinished(members: Sequence[Member]) -> list[Member]:
    """Return the runs whose command has something to do; of the others, set the failure that it would report."""
    waiting = [member for member in members if FRESH in member.command or not _is_complete(member.run)]
    for member in members:
        if member not in waiting:
            member.failure = _failure(member.run)
    return waiting


def _is_complete(run: Path) -> bool:
    """Return whether a run is finished and has its report; one that failed has none.

    Its command checks copies of plug-ins, so a run that has some is never complete. One of another engine is: its
    command would refuse to touch it.
    """
    if not (run / RECORD).is_file():
        return False
    record = read_record(run)
    if record.get("plugins"):
        return False
    if record.get("engine") != engine_hash():
        return record["status"] in FINISHED
    return record["status"] == "failed" or (record["status"] in FINISHED and (run / REPORT).is_file())


def _failure(run: Path) -> str | None:
    """Return why a finished run failed, as its command would report it, or None."""
    record = read_record(run)
    failed = record["status"] in ("failed", INFEASIBLE)
    return str(record["reason"]).strip().splitlines()[-1] if failed else None


@dataclass(frozen=True)
class Executor:
    """Makes the runs of a study that are not there yet.

    Attributes:
        source, out: scene file and directory of all results, which the commands of the runs name.
        scene, job: the scene, and the job of the runs.
        at_once: number of runs at once.
        on: `processes` of this machine, or a place of running/cluster.py.

    Raises:
        UsageError: there is no such place.
    """

    source: Path
    out: Path
    scene: Scene
    job: Job[Any, Any]
    at_once: int
    on: str = PROCESSES

    def __post_init__(self) -> None:
        require_place(self.on)

    def run(self, members: Sequence[Member], what: str, doing: str, talk: Reporter) -> None:
        """Make all runs that are not there yet; each gets its failure, if it has one.

        Args:
            what: what the runs are called, such as `seeds`.
            doing: what is done, such as `learning from 3 seeds, 2 at once`.

        Raises:
            UsageError, MissingExtra: the place cannot be used.
        """
        waiting = unfinished(members)
        there = len(members) - len(waiting)
        others = [m for m in members if m not in waiting and read_record(m.run).get("engine") != engine_hash()]
        if others:
            talk.warn(
                f"{len(others)} of {len(members)} {what} were made by another engine and are kept, such as "
                f"{others[0].run}: their last digits may differ; `--fresh` makes all of them again"
            )
        already = f"; {there} of {len(members)} {what} are there already" if there else ""
        talk.phase(f"{doing}{already}")
        if self.on == PROCESSES or not waiting:
            run_fleet(waiting, self.at_once, what, talk)
        else:
            parcel = self._parcel()
            run_on_cluster(waiting, self.on, self.at_once, what, talk, source=self.source, out=self.out, parcel=parcel)

    def _parcel(self) -> Parcel | None:
        """Return the scene and the files that it names; None for a run, or if one is not below the scene's folder."""
        scene, source = self.scene, self.source
        if source.is_dir():
            return None
        named = part_files(scene) | scene.plugin_paths() | (data_files(scene) if self.job.reads_data(scene) else {})
        folder, files = source.resolve().parent, {source.name: source.read_bytes()}
        for path in (path.resolve() for path in named.values()):
            if not path.is_relative_to(folder):
                return None
            files[str(path.relative_to(folder))] = path.read_bytes()
        return Parcel(source.name, files)
