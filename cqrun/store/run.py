"""The run directory: everything about one run, in a folder whose name is determined by the run's inputs.

results/<scene's stem>/<12 hex>/
  scene.yaml            resolved, complete       evals.*        what a resumed optimizer needs
  scene.original.yaml   as typed                 history.csv    one row per iteration
  run.json              status, provenance       result.json    the result
  log.txt               events by phase          figures/       report.html    lock
  plugins/              copies of plug-in files  trajectory.h5  the motion
  synthetic/            data that the run made
Jobs add controller.npz, activation.csv, observables.csv (learned.py, simulate.py), tracks.csv (predictions.py) and
design/ (export.py).
"""

from __future__ import annotations

import hashlib
import json
import re
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from cqrun.characters import harmless
from cqrun.disk import open_file
from cqrun.errors import CqrunError, StopNow, UsageError
from cqrun.explain import listed, shown
from cqrun.fingerprint import engine_hash
from cqrun.scene.origin import PLUGINS
from cqrun.store.atomic import disk_errors, write_bytes, write_json, write_text
from cqrun.store.folder import RECORD, clear, make_below, remove_temporary_files, require_own
from cqrun.store.history import History
from cqrun.store.lock import DirectoryLock
from cqrun.store.provenance import git_state, machine, now, versions
from cqrun.store.replay import ReplayLog
from cqrun.store.run_scene import RunScene, digest_of, hash_of
from cqrun.store.snapshots import Snapshots

NEW, RUNNING, STOPPED = "new", "running", "stopped"
FINISHED = ("done", "converged", "iteration_limit", "stalled", "infeasible", "failed")
LATER = (CqrunError, OSError, MemoryError)
"""Errors after which a run can go on: they say what has to change first. Others are faults of the program."""

SCENE = "scene.yaml"

KINDS: dict[str, type | tuple[type, ...]] = {
    "seconds": (int, float), "job": str, "base": str, "files": dict, "plugins": dict, "versions": dict,
    "extended": list, "scenes": list, "reason": (str, type(None)), "argv": list, "machine": dict, "began": str,
}  # fmt: skip
"""What an entry of run.json must be, if it is there."""

DIGEST = re.compile("[0-9a-f]{64}")


class RunDirectory:
    """A run directory that this process has locked; a context manager that releases it.

    Use `open` (with a scene) or `resume` (with a directory) to get one. If the context ends with an error before
    `finish`, the run is marked as stopped and can be resumed.

    Attributes:
        path: the directory.
        record: the content of run.json.
    """

    def __init__(self, path: Path, lock: DirectoryLock) -> None:
        self.path, self._lock = path, lock
        self.record: dict[str, Any] = {"status": NEW, "seconds": 0.0}
        self._began = time.monotonic()
        self._files: list[History | ReplayLog] = []

    @classmethod
    def open(
        cls,
        scene: RunScene,
        out: Path,
        *,
        argv: Sequence[str],
        seed: int,
        threads: int,
        fresh: bool = False,
    ) -> RunDirectory:
        """Make the run of `scene` below `out`, or open it if it exists.

        Args:
            scene: the inputs of the run.
            out: directory of all results.
            argv: the command line, for the record.
            seed: seed of the run.
            threads: number of threads, for the record.
            fresh: delete an existing run and start over.

        Raises:
            UsageError: another process has locked the run, another engine made it, it cannot be written, or something
                lies there that cqrun did not write.
            RunError: the disk is full.
        """
        path = make_below(out, scene.stem, scene.digest())
        require_own(path)
        run = cls(path, DirectoryLock(path))
        try:
            if fresh or not (path / RECORD).exists():
                run._create(scene, job=scene.job, argv=list(argv), seed=seed, threads=threads)
            else:
                run._load()
        except BaseException:
            run.close()
            raise
        return run

    @classmethod
    def resume(cls, path: Path) -> RunDirectory:
        """Open the run in `path` to continue it.

        Raises:
            UsageError: it is not a run, another process has locked it, or another engine made it.
        """
        read_record(path)
        run = cls(path, DirectoryLock(path))
        try:
            run._load()
        except BaseException:
            run.close()
            raise
        return run

    @property
    def status(self) -> str:
        """The status: new, running (also after a kill), stopped, or one of FINISHED."""
        return str(self.record["status"])

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do, unless the scene is extended."""
        return self.status in FINISHED

    @property
    def warning(self) -> str | None:
        """What the user should know about the place where the run is, or None."""
        if self._lock.works:
            return None
        return f"{self.path}: this file system has no locks, so nothing keeps a second process away: run only one"

    @property
    def resolved(self) -> str:
        """The text of the resolved scene; UsageError if it is missing or damaged."""
        return read_scene(self.path, self.record)

    def elapsed(self) -> float:
        """Return the time spent on this run, including earlier processes [s]."""
        return float(self.record["seconds"]) + time.monotonic() - self._began

    def begin(self, threads: int | None = None) -> None:
        """Mark the run as running; its time starts now, after kernels were compiled."""
        self._began = time.monotonic()
        self._write({"status": RUNNING, "reason": None} | ({} if threads is None else {"threads": threads}))

    def finish(self, status: str, reason: str) -> None:
        """Mark the run as ended, with the status `stopped` (it can be resumed) or one of FINISHED."""
        if status not in (STOPPED, *FINISHED):
            raise ValueError(f"'{status}' is not a status with which a run can end")
        self.log(f"{status}: {reason}")
        self._add_time()
        self._write({"status": status, "reason": reason})

    def add_facts(self, **facts: Any) -> None:
        """Add facts to run.json that are not part of the result, because they may differ between equal runs."""
        self._write(facts)

    def extend(self, resolved: str, overrides: Sequence[str]) -> None:
        """Continue with a changed scene, for example with more iterations; the run keeps its name."""
        self.record["extended"] = [*self.record.get("extended", []), list(overrides)]
        # if the process is killed before the last line, the run has one of these two scenes
        self.record["scenes"] = [hash_of(text) for text in (self.resolved, resolved)]
        self.log("extended: " + " ".join(overrides))
        self.begin()  # first: a run that is killed here continues with its old scene
        write_text(self.path / SCENE, resolved)

    def is_as_begun(self) -> bool:
        """Return whether the folder is named after scene.yaml; the scene that `extend` wrote does not name it."""
        if self.record.get("extended"):
            return bool(self.resolved)
        return digest_of(self.record["job"], self.resolved, self.record["files"]) == self.path.name

    def log(self, text: str) -> None:
        """Append a line to log.txt."""
        path = self.path / "log.txt"
        with disk_errors(path), open_file(path, "a", encoding="utf-8", errors="backslashreplace") as file:
            file.write(f"[{self.elapsed():10.3f} s] {harmless(text)}\n")

    def history(self, columns: Sequence[str]) -> History:
        """Open history.csv; `elapsed` continues from its last row, also after a kill."""
        history = History(self.path / "history.csv", columns)
        self._files.append(history)
        self.record["seconds"] = max(self.record["seconds"], history.seconds)
        return history

    def replay_log(self) -> ReplayLog:
        """Open the log of evaluations for an optimizer that cannot save its state."""
        log = ReplayLog(self.path / "evals.log", self.log)
        self._files.append(log)
        return log

    def snapshots(self) -> Snapshots:
        """Return the state files for an optimizer that saves its state."""
        return Snapshots(self.path / "evals", self.log)

    def close(self) -> None:
        """Release the run; a second call does nothing."""
        for file in self._files:
            file.close()
        self._files.clear()
        self._lock.release()

    def __enter__(self) -> RunDirectory:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is not None and self.status == RUNNING:
                ended = STOPPED if isinstance(error, LATER) or not isinstance(error, Exception) else "failed"
                self.finish(ended, "aborted" if isinstance(error, StopNow) else f"{type(error).__name__}: {error}")
        except CqrunError as second:
            assert error is not None
            error.add_note(f"run.json still says 'running': {second}")
        finally:
            self.close()

    def _create(self, scene: RunScene, **facts: Any) -> None:
        clear(self.path, scene.tables)
        write_text(self.path / SCENE, scene.resolved)
        write_text(self.path / "scene.original.yaml", scene.original)
        copies = {path.name: path.read_bytes() for path in scene.plugins.values()}
        if copies:
            make_below(self.path, PLUGINS)
        for name, content in copies.items():
            write_bytes(self.path / PLUGINS / name, content)
        self._write(
            {
                "status": NEW,
                "reason": None,
                **facts,
                "base": scene.base,
                "files": scene.contents(),
                "scenes": [hash_of(scene.resolved)],
                "plugins": {name: hashlib.sha256(content).hexdigest() for name, content in copies.items()},
                "engine": engine_hash(),
            }
            | {"versions": versions(), "git": git_state(), "machine": machine(), "began": now(), "seconds": 0.0}
        )  # last: if run.json exists, the rest is complete

    def _load(self) -> None:
        remove_temporary_files(self.path)
        self.record = read_record(self.path)
        if absent := [name for name in ("job", "files", "base") if name not in self.record]:
            raise UsageError(
                f"{self.path / RECORD}: damaged (no {listed(absent)} in it); run the scene again with --fresh"
            )
        made_by, here = self.record.get("engine"), engine_hash()
        if made_by != here:
            version = self.record.get("versions", {}).get("cqrun", "unknown")
            raise UsageError(
                f"{self.path}: made by another engine (cqrun {version}, engine {made_by}; this is {here}), "
                "so its results would not be bit-for-bit identical; run the scene again with --fresh to start over, or "
                "with --out DIR to keep both, or continue it with the cqrun and libraries that run.json names"
            )
        self._require_same_plugins()

    def _require_same_plugins(self) -> None:
        """Refuse to run copies of plug-in files that have changed since the run began."""
        for name, digest in self.record.get("plugins", {}).items():
            path = self.path / PLUGINS / name
            if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
                raise UsageError(f"{path}: this copy of a plug-in has changed since the run began; run the scene again")

    def _add_time(self) -> None:
        self.record["seconds"] = round(self.elapsed(), 3)
        self._began = time.monotonic()

    def _write(self, changes: Mapping[str, Any]) -> None:
        self.record.update(changes)
        write_json(self.path / RECORD, self.record)


def read_record(path: Path) -> dict[str, Any]:
    """Return run.json of the run in `path`, without locking the run.

    Raises:
        UsageError: there is no run, its record cannot be read, or it holds a link.
    """
    require_own(path)
    file = path / RECORD
    if not file.is_file():
        inside = sorted(str(p.parent) for p in path.glob(f"*/{RECORD}"))[:5] if path.is_dir() else []
        hint = f"; it holds runs: {', '.join(inside)}" if inside else ""
        raise UsageError(
            f"{path}: no run (it has no {RECORD}); a run is a directory results/<scene>/<12 hex digits>{hint}"
        )
    try:
        with open_file(file, "r", encoding="utf-8") as text:
            record = json.load(text)
        _require_record(record)
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{file}: unreadable ({error}); run the scene again with --fresh") from error
    return record


def _require_record(record: Any) -> None:
    """Refuse what cannot be a run's record; ValueError says why."""
    if not isinstance(record, dict) or "status" not in record or "seconds" not in record:
        raise ValueError("no status in it")
    if record["status"] not in (NEW, RUNNING, STOPPED, *FINISHED):
        raise ValueError(f"status: is {shown(record['status'])}, which is none of a run")
    for name, kind in KINDS.items():
        if name in record and not isinstance(record[name], kind):
            raise ValueError(f"{name}: is {shown(record[name])}")
    for name in ("files", "plugins"):
        for file, digest in record.get(name, {}).items():
            if not isinstance(digest, str) or not DIGEST.fullmatch(digest):
                raise ValueError(f"{name}: the hash of '{file}' is {shown(digest)}")


def read_scene(path: Path, record: Mapping[str, Any]) -> str:
    """Return the text of a run's resolved scene.

    Raises:
        UsageError: it is missing, or not the one that the run has written.
    """
    file = path / SCENE
    try:
        with open_file(file, "r", encoding="utf-8") as text:
            scene = str(text.read())
    except FileNotFoundError:
        raise UsageError(
            f"{path}: there is no {SCENE}; the run is incomplete, run its scene again with --fresh"
        ) from None
    except (OSError, ValueError) as error:
        raise UsageError(f"{file}: unreadable ({error}); run the scene again with --fresh") from error
    scenes = record.get("scenes")  # runs of earlier versions have none
    if scenes and hash_of(scene) not in scenes:
        raise UsageError(
            f"{file}: has changed since the run began; put it back, or run the scene that you want with a new command"
        )
    return scene
