"""Read the data of a run directory that pictures need, whether the run is finished, running or stopped."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.disk import open_file
from cqrun.errors import UsageError
from cqrun.measurements.markers import Markers
from cqrun.measurements.measurement import Measurement
from cqrun.plugin.contract import Array
from cqrun.running.runs import kept_scene
from cqrun.scene.schema import Scene
from cqrun.store.frames import Frames, part_path
from cqrun.store.history import read_history
from cqrun.store.result import Result, read_result
from cqrun.store.run import FINISHED, read_record
from cqrun.store.trajectory import Trajectory, read_trajectory

HISTORY, TRAJECTORY = "history.csv", "trajectory.h5"

TIME = "time"
"""What a recording in motion is shown against."""


@dataclass(frozen=True)
class Tracks:
    """One recording and the model, in the measurement's unit.

    Attributes:
        recording: name of the recording.
        channels: names of the M channels, such as markers.
        time: time since the release (T,) [s]; at rest the number of each point, or its load.
        data: recorded values (T, M, D); NaN where a channel was not seen.
        model: values in the model (T, M, D).
        holdout: whether the recording was held out of the fit.
        components: names of the D components.
        measurement: what was measured, and its unit.
        axis: what `time` is called.
        labels: names of the points at rest; empty if they have numbers.
    """

    recording: str
    channels: tuple[str, ...]
    time: Array
    data: Array
    model: Array
    holdout: bool = False
    components: tuple[str, ...] = ("x", "y", "z")
    measurement: type[Measurement] = Markers
    axis: str = TIME
    labels: tuple[str, ...] = ()

    @property
    def at_rest(self) -> bool:
        """Whether bodies are at rest, so that there is no time."""
        return self.measurement.at_rest and self.axis != TIME

    @property
    def error(self) -> Array:
        """Distance between data and model (T, M); NaN where not seen."""
        return np.asarray(np.sqrt(np.sum((self.data - self.model) ** 2, axis=2)))

    def rmse(self) -> float:
        """Return the root mean square error over all seen values."""
        return _root_mean_square(self.error)

    def rmse_by_channel(self) -> Array:
        """Return the root mean square error of each channel (M,); NaN for a channel that was never seen."""
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
        result: result of the run, or None if there is none yet.
    """

    path: Path
    record: dict[str, Any]
    scene: Scene
    history: dict[str, Array]
    result: Result | None

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
            UsageError: the table of a recording is missing or cannot be read.
        """
        self.require_tables("so there is nothing to draw beside the model")
        holdouts = {name for name, recording in self.scene.recordings.items() if recording.holdout}
        return [
            tracks
            for name, measurement in self.tables.items()
            if self.has(name)
            for tracks in read_tracks(self.path / name, holdouts, measurement)
        ]

    @property
    def tables(self) -> dict[str, type[Measurement]]:
        """The files with data and model that a run of sysid writes, each with its measurement."""
        data = self.scene.data
        return {} if data is None else {m.table_name: type(m) for m in data.measurements}

    def has_tables(self) -> bool:
        """Return whether a file with data and model exists."""
        return any(self.has(name) for name in self.tables)

    def require_tables(self, why: str) -> None:
        """Raise a UsageError if no file with data and model exists."""
        if not self.has_tables():
            self.require(next(iter(self.tables), Markers.table_file()), why)

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
    return RunData(path, record, kept_scene(path, record), _history(path / HISTORY), read_result(path))


def _history(path: Path) -> dict[str, Array]:
    if not path.is_file():
        return {}
    rows = {name: np.array(column) for name, column in read_history(path).items()}
    return rows if len(rows["iteration"]) else {}


def read_tracks(
    path: Path, holdouts: set[str] | frozenset[str] = frozenset(), measurement: type[Measurement] = Markers
) -> list[Tracks]:
    """Read a table; each row has recording, channel, time (or point), then the components of data and model.

    Raises:
        UsageError: the file is not such a table.
    """
    try:
        with open_file(path, "r", newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(f"{path}: unreadable ({error}); run the scene again with --fresh") from error
    header, body = (rows[0], rows[1:]) if rows else ([], [])
    components = tuple(name.removeprefix("data_") for name in header if name.startswith("data_"))
    timed = measurement.at_rest or header[2:3] == [TIME]
    named = header[:2] == ["recording", measurement.channel] and timed
    if not named or len(header) != 3 + 2 * len(components) or not body:
        raise UsageError(f"{path}: is not a table of {measurement.channel}s; run the scene again with --fresh")
    if short := next((row for row in body if len(row) != len(header)), None):
        raise UsageError(f"{path}: damaged (a row has {len(short)} columns); run the scene again with --fresh")
    grouped: dict[str, dict[str, list[list[str]]]] = {}
    for row in body:
        grouped.setdefault(row[0], {}).setdefault(row[1], []).append(row[2:])
    try:
        return [
            _tracks(name, own, len(components), measurement, header[2], name in holdouts, components)
            for name, own in grouped.items()
        ]
    except ValueError as error:
        raise UsageError(f"{path}: damaged ({error}); run the scene again with --fresh") from error


def _tracks(
    name: str, channels: dict[str, list[list[str]]], dim: int, measurement: type[Measurement], axis: str, holdout: bool,
    components: tuple[str, ...],
) -> Tracks:  # fmt: skip
    """Return the tracks of a recording from the rows of each channel: time or point, data, model."""
    points = [row[0] for row in next(iter(channels.values()))]
    named = measurement.at_rest and axis != TIME and not all(map(_is_number, points))
    labels = tuple(points) if named else ()
    along = np.arange(1.0, len(points) + 1) if labels else np.array(points, dtype=float)
    rows = [[row[1:] for row in rows] for rows in channels.values()]
    numbers = np.array(rows, dtype=float).transpose(1, 0, 2)
    data, model = numbers[:, :, :dim], numbers[:, :, dim:]
    return Tracks(name, tuple(channels), along, data, model, holdout, components, measurement, axis, labels)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
