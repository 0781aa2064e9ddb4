"""Open, name and check run directories and their scenes, for all jobs."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cqrun.build.measures import bound_measures
from cqrun.build.model import Built, build
from cqrun.errors import InfeasibleError, Problem, RunError, SceneError, UsageError
from cqrun.optimizers.base import Optimizer
from cqrun.optimizers.constrained import VIOLATION
from cqrun.plugin.contract import Array
from cqrun.running.extra_fields import ExtraFields
from cqrun.running.reporter import Reporter
from cqrun.scene.files import DATA, READ_BY_EVERY_JOB, files_by_name, named_files, unreadable_files
from cqrun.scene.keypath import joined
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.schema import Scene
from cqrun.store.folder import RECORD
from cqrun.store.history import read_history
from cqrun.store.run import SCENE, RunDirectory, read_record, read_scene
from cqrun.store.run_scene import RunScene

EXTENDED = "`cqrun resume` has given it more iterations than this scene has"
"""The warning if a command asks for the original scene of an extended run."""


def build_and_warn(scene: Scene, talk: Reporter) -> Built:
    """Build a scene and report its warnings."""
    built = build(scene)
    bound_measures(built)  # report quantities and fields that do not fit
    ExtraFields(built)
    for warning in built.warnings:
        talk.warn(str(warning))
    return built


def optimizer_of(scene: Scene) -> Optimizer:
    """Return the optimizer of a scene; a job has set it if the scene names none."""
    assert scene.optimizer is not None
    optimizer = scene.optimizer.value
    assert isinstance(optimizer, Optimizer)
    return optimizer


def open_run(
    stem: str, scene: Scene, out: Path, *, job: str, threads: int, fresh: bool, with_data: bool = True,
    files: Mapping[str, Path] | None = None,
) -> RunDirectory:  # fmt: skip
    """Create the run of a resolved scene in `out`, or open the existing one.

    Args:
        stem: name of the scene, and of the folder of its runs.
        with_data: whether the job reads the recordings of the scene.
        files: other files that the run depends on, by name.

    Raises:
        SceneError: a file of the scene is missing. UsageError, RunError: as `RunDirectory.open`.
    """
    if unreadable := unreadable_files(scene, READ_BY_EVERY_JOB):
        raise SceneError(unreadable)
    inputs = run_scene(stem, scene, job=job, with_data=with_data, files=files)
    return RunDirectory.open(inputs, out, argv=sys.argv, seed=scene.seed, threads=threads, fresh=fresh)


def run_scene(
    stem: str, scene: Scene, *, job: str, with_data: bool, files: Mapping[str, Path] | None = None
) -> RunScene:
    """Return the inputs whose hash names the run of a resolved scene; arguments as `open_run`.

    Raises:
        SceneError: a recording is missing.
    """
    read = {**part_files(scene), **(data_files(scene) if with_data else {}), **(files or {})}
    base = str(scene.resolve_path("").resolve())
    tables = () if scene.data is None else tuple(m.table_name for m in scene.data.measurements)
    return RunScene(stem, dump(resolve(scene)), scene.text, read, base, job, scene.plugin_paths(), tables)


def part_files(scene: Scene) -> dict[str, Path]:
    """Return the files of a scene that are not in `data`, by their names in the scene."""
    return files_by_name(scene, of_data=False)


def data_files(scene: Scene) -> dict[str, Path]:
    """Return the files of a scene's `data`, by their names in the scene; raise SceneError for all missing ones."""
    problems = []
    for loc, name in named_files(scene):
        path, key = scene.resolve_path(name), joined(loc)
        if loc[0] == DATA and not os.path.isfile(path):  # noqa: PTH113  Path's own raises at a long name
            message = (
                f"there is no file '{path}'; the scene's header says where to download the recordings; "
                f"if it is elsewhere, use -o {key}=FILE (an absolute path, or relative to the scene's folder)"
            )
            problems.append(Problem(scene.where(key), key, message))
    if problems:
        raise SceneError(problems)
    return files_by_name(scene, of_data=True)


def kept_scene(folder: Path, record: Mapping[str, Any], overrides: Sequence[str] = ()) -> Scene:
    """Return the scene in the folder of a run, which names its files from where the run began.

    Raises:
        UsageError: it is missing or damaged. SceneError: this version cannot read it.
    """
    read_scene(folder, record)
    return load_scene(folder / SCENE, overrides, Path(str(record.get("base", ""))))


def saved_scene(run: RunDirectory, overrides: Sequence[str] = ()) -> Scene:
    """Return the scene in a run directory; its relative paths start at the folder of the original scene.

    Raises:
        UsageError: the scene, or a file that it uses, has changed since the run began.
    """
    if not run.is_as_begun():
        raise UsageError(
            f"{run.path}: the folder's name does not match its scene: the folder was renamed, or its scene.yaml has "
            "changed since the run began; restore the name, or run the scene again"
        )
    scene = kept_scene(run.path, run.record, overrides)
    _require_as_begun(run.path, run.record, part_files(scene))
    return scene


def scene_in(folder: Path, overrides: Sequence[str] = (), *, with_data: bool = False) -> Scene:
    """Return the scene of the run in a folder, without locking the run.

    Args:
        folder: the run directory.
        overrides: overrides of the scene; files that they name are not checked.
        with_data: whether the job reads the recordings of the scene.

    Raises:
        UsageError: there is no run, or a file that its scene uses has changed since.
    """
    record = read_record(folder)
    scene = kept_scene(folder, record, overrides)
    data = files_by_name(scene, of_data=True) if with_data else {}
    _require_as_begun(folder, record, part_files(scene) | data)
    return scene


@dataclass(frozen=True)
class Source:
    """What a command runs.

    Attributes:
        stem: name of the scene, and of the folder of its runs.
        scene: the scene; in a replay with the single numbers that the replayed run found.
        files: by name, the files of which the run keeps copies, with all else that a replayed run found.
    """

    stem: str
    scene: Scene
    files: Mapping[str, Path] = field(default_factory=dict)


def is_run(source: Path) -> bool:
    """Return whether a path is the directory of a run, and not the file of a scene."""
    return source.is_dir() and (source / RECORD).is_file()


def scene_of(source: Path, overrides: Sequence[str]) -> Scene:
    """Return the scene of a file or of a run.

    Raises:
        SceneError, UsageError: as `load_scene` and `scene_in`.
    """
    return scene_in(source, overrides) if is_run(source) else load_scene(source, overrides)


def _require_as_begun(run: Path, record: Mapping[str, Any], files: Mapping[str, Path]) -> None:
    """Raise UsageError for files that have changed since the run began; missing files are reported later."""
    for name, path in files.items():
        began_with = record.get("files", {}).get(name)
        if path.is_file() and began_with not in (None, hashlib.sha256(path.read_bytes()).hexdigest()):
            raise UsageError(
                f"{run}: {path} has changed since the run began; run the scene again, or restore the original file"
            )


def require_same_data(run: RunDirectory) -> None:
    """Raise UsageError if recordings have changed since the run began, or SceneError if one is missing."""
    scene = saved_scene(run)
    read = RunScene("", run.resolved, "", part_files(scene) | data_files(scene), plugins=scene.plugin_paths())
    if read.contents() != run.record["files"]:
        raise UsageError(f"{run.path}: a recording that it names has changed since the run began; run the scene again")


def finished_already(run: RunDirectory, talk: Reporter, *, asked_by_scene: bool = True) -> bool:
    """Return and report whether a run is finished; warn if the command asks for the scene of an extended run."""
    over = "; --fresh starts over" if asked_by_scene else ""
    if run.finished:
        talk.phase(f"finished already ({run.status}){over}")
    if asked_by_scene and run.record.get("extended"):
        talk.warn(f"{run.path}: {EXTENDED}{over}")
    return run.finished


def refuse_overrides(run: RunDirectory, overrides: Sequence[str]) -> None:
    """Raise UsageError for overrides of a job that cannot be extended."""
    if overrides:
        job = run.record["job"]
        raise UsageError(
            f"-o {overrides[0]}: a run of {job} cannot be extended; a changed scene is another run: "
            f"cqrun {job} SCENE -o {overrides[0]}"
        )


def raise_if_failed(run: Path) -> Path:
    """Return the directory of a run, or raise the error that it ended with."""
    record = read_record(run)
    if record["status"] == "infeasible":
        raise InfeasibleError(run, record["reason"])
    if record["status"] == "failed":
        raise RunError(f"{run}: {record['reason']}")
    return run


def require_extension(run: RunDirectory, overrides: Sequence[str]) -> None:
    """Raise UsageError for overrides that do not extend a run, or that ask for fewer iterations than it has done."""
    if overrides and run.record["job"] == "sysid" and saved_scene(run).predicts_only:
        why = "nothing is fitted, so it has no iterations: every recording is held out"
        raise UsageError(f"-o {overrides[0]}: {why}")
    for override in overrides:
        key, _, value = override.partition("=")
        if not (key.startswith("optimizer.") and key.endswith(".max_iterations")):
            raise UsageError(
                f"-o {override}: a run can only be extended (optimizer.*.max_iterations); "
                "any other change is another run: start it from the scene"
            )
        done = iterations_done(run)
        wanted = yaml.safe_load(value)
        if isinstance(wanted, int) and wanted < done + run.finished:
            raise UsageError(f"-o {override}: the run has done {done} iterations, and can only be extended: give more")


def iterations_done(run: RunDirectory) -> int:
    """Return the number of iterations that a run has done."""
    path = run.path / "history.csv"
    rows = read_history(path).get("iteration") if path.is_file() else None
    return 0 if rows is None or not len(rows) else int(rows[-1])


class Progress:
    """Reports every iteration, with the best loss so far."""

    def __init__(self, run: RunDirectory, talk: Reporter) -> None:
        self._run, self._talk = run, talk
        self._best, self._last, self._x = np.inf, run.elapsed(), np.zeros(0)

    def __call__(self, iteration: int, x: Array, loss: float, terms: Mapping[str, float]) -> None:
        now = self._run.elapsed()
        step = float(np.linalg.norm(x - self._x)) if len(self._x) == len(x) else 0.0
        self._best, self._x = min(self._best, loss), x.copy()
        if iteration > 0:
            self._talk.update(iteration, loss, self._best, step, now - self._last, terms.get(VIOLATION))
        self._last = now
