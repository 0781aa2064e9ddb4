"""What pictures need of a run directory, whether the run is finished, going on or was stopped."""

from __future__ import annotations

import csv
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
from cqrun.store.result import Result, read_result
from cqrun.store.run import FINISHED, read_record
from cqrun.store.trajectory import Trajectory, read_trajectory

HISTORY, TRACKS, TRAJECTORY, SCENE = "history.csv", "tracks.csv", "trajectory.h5", "scene.yaml"


@dataclass(frozen=True)
class Tracks:
    """One recording beside the model.

    Attributes:
        recording: its name.
        markers: M names.
        time: (T,) since the release [s].
        data: (T, M, D) [m]; NaN where a marker was not seen.
        model: (T, M, D) [m].
        holdout: predicted, never fitted.
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
        """Return the root mean square error over what was seen [m]."""
        return _root_mean_square(self.error)

    def rmse_by_marker(self) -> Array:
        """Return the same by marker (M,) [m]; NaN for one that is not seen."""
        return np.array([_root_mean_square(column) for column in self.error.T])


def _root_mean_square(error: Array) -> float:
    seen = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(seen**2))) if seen.size else float("nan")


@dataclass(frozen=True)
class RunData:
    """A run as its directory tells it.

    Attributes:
        path: the directory.
        record: run.json.
        scene: resolved.
        history: columns by name (K,); empty if there are no rows yet.
        result: what the run found, or None while there is nothing.
    """

    path: Path
    record: dict[str, Any]
    scene: Scene
    history: dict[str, Array]
    result: Result | None

    @property
    def job(self) -> str:
        """What was run, such as sysid."""
        return str(self.record.get("job", ""))

    @property
    def name(self) -> str:
        """The scene file's stem."""
        return self.path.resolve().parent.name

    @property
    def status(self) -> str:
        """How the run ended, or that it goes on, in words."""
        return str(self.record["status"]).replace("_", " ")

    @property
    def succeeded(self) -> bool:
        """Whether the run came to its end and found something."""
        status = self.record["status"]
        return status in FINISHED and status != "failed"

    def has(self, name: str) -> bool:
        """Say whether a file of the run is there."""
        return (self.path / name).is_file()

    def require(self, name: str, why: str) -> None:
        """Raise a UsageError if a file of the run is missing."""
        if not self.has(name):
            raise UsageError(f"{self.path}: there is no {name}, {why}")

    def tracks(self) -> list[Tracks]:
        """Return every recording beside the model.

        Raises:
            UsageError: there is no tracks.csv, or it cannot be read.
        """
        self.require(TRACKS, "so there are no markers to draw")
        holdouts = {name for name, recording in self.scene.recordings.items() if recording.holdout}
        return read_tracks(self.path / TRACKS, holdouts)

    def has_trajectory(self) -> bool:
        """Say whether there is a trajectory, perhaps one that is being written."""
        path = self.path / TRAJECTORY
        return path.is_file() or part_path(path).is_file()

    def frames(self) -> Frames:
        """Return the trajectory opened, a context manager that reads frame by frame; UsageError without one."""
        return Frames(self.path / TRAJECTORY)

    def trajectory(self) -> Trajectory:
        """Return the trajectory, all of it in memory; UsageError without one."""
        return read_trajectory(self.path / TRAJECTORY)


def read_run(path: Path) -> RunData:
    """Read a run's directory.

    Raises:
        UsageError: it is no run, or a file of it cannot be read.
        SceneError: its scene cannot be read by this version.
    """
    record = read_record(path)
    scene_file = path / SCENE
    if not scene_file.is_file():
        raise UsageError(f"{path}: there is no {SCENE}; the run is incomplete, run its scene again with --fresh")
    scene = load_scene(scene_file, (), Path(record.get("base") or "."))
    return RunData(path, record, scene, _history(path / HISTORY), read_result(path))


def _history(path: Path) -> dict[str, Array]:
    if not path.is_file():
        return {}
    try:
        columns = read_history(path)
    except (ValueError, IndexError) as error:
        raise UsageError(f"{path}: unreadable ({error}); run the scene again with --fresh") from error
    rows = {name: np.array(column) for name, column in columns.items()}
    return rows if rows and len(rows["iteration"]) else {}


def read_tracks(path: Path, holdouts: set[str] | frozenset[str] = frozenset()) -> list[Tracks]:
    """Read tracks.csv: a row is recording, marker, time, then data and model coordinates.

    Raises:
        UsageError: it is not such a table.
    """
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    header, body = (rows[0], rows[1:]) if rows else ([], [])
    dim = sum(name.startswith("data_") for name in header)
    if header[:3] != ["recording", "marker", "time"] or len(header) != 3 + 2 * dim or not body:
        raise UsageError(f"{path}: no table of tracks; run the scene again with --fresh")
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
