"""Read the data of a run directory that pictures need, whether the run is finished, running or stopped."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.errors import UsageError
from cqrun.plugin.contract import Array
from cqrun.scene.load import load_scene
from cqrun.scene.schema import Scene
from cqrun.store.frames import Frames, part_path
from cqrun.store.history import read_history
from cqrun.store.run import FINISHED, read_record
from cqrun.store.trajectory import Trajectory, read_trajectory

HISTORY, RESULT, TRACKS, TRAJECTORY, SCENE = "history.csv", "result.json", "tracks.csv", "trajectory.h5", "scene.yaml"


@dataclass(frozen=True)
class Tracks:
    """Tracks of markers in one recording and in the model.

    Attributes:
        recording: name of the recording.
        markers: names of the M markers.
        time: time since the release (T,) [s].
        data: recorded positions (T, M, D) [m]; NaN where a marker was not seen.
        model: positions in the model (T, M, D) [m].
        holdout: whether the recording was held out of the fit.
    """

    recording: str
    markers: tuple[str, ...]
    time: Array
    data: Array
    model: Array
    holdout: bool = False

    @property
    def error(self) -> Array:
        """Distance between data and model (T, M) [m]; NaN where not seen."""
        return np.asarray(np.sqrt(np.sum((self.data - self.model) ** 2, axis=2)))

    def rmse(self) -> float:
        """Return the root mean square error over all seen positions [m]."""
        return _root_mean_square(self.error)

    def rmse_by_marker(self) -> Array:
        """Return the root mean square error of each marker (M,) [m]; NaN for a marker that was never seen."""
        return np.array([_root_mean_square(column) for column in self.error.T])


def _root_mean_square(error: Array) -> float:
    seen = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(seen**2))) if seen.size else float("nan")


@dataclass(frozen=True)
class RunData:
    """The content of a run directory.

    Attributes:
        path: the directory.
        record: content of run.json.
        scene: the resolved scene.
        history: columns by name (K,); empty if there are no rows yet.
        result: content of result.json, or None if there is none yet.
    """

    path: Path
    record: dict[str, Any]
    scene: Scene
    history: dict[str, Array]
    result: dict[str, Any] | None

    @property
    def job(self) -> str:
        """The job, such as sysid."""
        return str(self.record.get("job", ""))

    @property
    def name(self) -> str:
        """The stem of the scene file."""
        return self.path.resolve().parent.name

    @property
    def status(self) -> str:
        """The status in words: how the run ended, or that it is running."""
        return str(self.record["status"]).replace("_", " ")

    @property
    def succeeded(self) -> bool:
        """Whether the run has finished without failing."""
        status = self.record["status"]
        return status in FINISHED and status != "failed"

    def has(self, name: str) -> bool:
        """Return whether a file of the run exists."""
        return (self.path / name).is_file()

    def require(self, name: str, why: str) -> None:
        """Raise a UsageError if a file of the run is missing."""
        if not self.has(name):
            raise UsageError(f"{self.path}: there is no {name}, {why}")

    def tracks(self) -> list[Tracks]:
        """Return the tracks of every recording.

        Raises:
            UsageError: tracks.csv is missing or cannot be read.
        """
        self.require(TRACKS, "so there are no markers to draw")
        holdouts = {name for name, recording in self.scene.recordings.items() if recording.holdout}
        return read_tracks(self.path / TRACKS, holdouts)

    def has_trajectory(self) -> bool:
        """Return whether there is a trajectory, perhaps incomplete."""
        path = self.path / TRAJECTORY
        return path.is_file() or part_path(path).is_file()

    def frames(self) -> Frames:
        """Open the trajectory to read it frame by frame (a context manager); raise a UsageError if there is none."""
        return Frames(self.path / TRAJECTORY)

    def trajectory(self) -> Trajectory:
        """Return the whole trajectory in memory; raise a UsageError if there is none."""
        return read_trajectory(self.path / TRAJECTORY)


def read_run(path: Path) -> RunData:
    """Read a run directory.

    Raises:
        UsageError: the path is not a run, or one of its files cannot be read.
        SceneError: this version cannot read the scene.
    """
    record = read_record(path)
    scene_file = path / SCENE
    if not scene_file.is_file():
        raise UsageError(f"{path}: there is no {SCENE}; the run is incomplete, run its scene again with --fresh")
    scene = load_scene(scene_file, (), Path(record.get("base") or "."))
    return RunData(path, record, scene, _history(path / HISTORY), _result(path / RESULT))


def _history(path: Path) -> dict[str, Array]:
    if not path.is_file():
        return {}
    try:
        columns = read_history(path)
    except (ValueError, IndexError) as error:
        raise UsageError(f"{path}: unreadable ({error}); run the scene again with --fresh") from error
    rows = {name: np.array(column) for name, column in columns.items()}
    return rows if rows and len(rows["iteration"]) else {}


def _result(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    try:
        result = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: unreadable ({error}); run the scene again with --fresh") from error
    if not isinstance(result, dict):
        raise UsageError(f"{path}: is not a result; run the scene again with --fresh")
    return result


def read_tracks(path: Path, holdouts: set[str] | frozenset[str] = frozenset()) -> list[Tracks]:
    """Read tracks.csv; each row has recording, marker, time, then the coordinates of data and model.

    Raises:
        UsageError: the file is not such a table.
    """
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    header, body = (rows[0], rows[1:]) if rows else ([], [])
    dim = sum(name.startswith("data_") for name in header)
    if header[:3] != ["recording", "marker", "time"] or len(header) != 3 + 2 * dim or not body:
        raise UsageError(f"{path}: is not a table of tracks; run the scene again with --fresh")
    grouped: dict[str, dict[str, list[list[str]]]] = {}
    for row in body:
        grouped.setdefault(row[0], {}).setdefault(row[1], []).append(row[2:])
    try:
        return [_tracks(name, markers, dim, name in holdouts) for name, markers in grouped.items()]
    except ValueError as error:
        raise UsageError(f"{path}: damaged ({error}); run the scene again with --fresh") from error


def _tracks(name: str, markers: dict[str, list[list[str]]], dim: int, holdout: bool) -> Tracks:
    numbers = np.array([rows for rows in markers.values()], dtype=float).transpose(1, 0, 2)
    data, model = numbers[:, :, 1 : 1 + dim], numbers[:, :, 1 + dim :]
    return Tracks(name, tuple(markers), numbers[:, 0, 0], data, model, holdout)
