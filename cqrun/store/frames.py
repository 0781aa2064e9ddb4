"""Read a trajectory of any length frame by frame; store/trajectory.py describes the file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from cqrun.disk import require_ordinary
from cqrun.errors import UsageError
from cqrun.plugin.contract import Array


def part_path(path: Path) -> Path:
    """Return the name of a trajectory while it is being written."""
    return path.with_name(path.name + ".part")


class Frames:
    """An open trajectory, perhaps incomplete or still being written by another process; a context manager.

    Attributes:
        path: the file that is read: the final name, or the `.part` if only that exists.
        time: times of the written frames (T,) [s].
        step: number of the substep or control step of each frame (T,).
        bodies: slice of each body's particles.
        fields: names of the fields of every particle, including x.
        provenance: the attributes given to the writer.
        complete: whether every frame was written and the file closed.

    Raises:
        UsageError: there is no trajectory, or it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        import h5py

        self.path = path if path.exists() else part_path(path)
        if not self.path.exists():
            raise UsageError(f"{path}: no such trajectory")
        require_ordinary(self.path)
        with self._reading():
            self._file = h5py.File(self.path, "r", locking=False)  # also while a writer has it open
        try:
            with self._reading():
                self._read_head()
        except UsageError:
            self.close()
            raise
        self.complete = self.path.suffix != ".part"

    def _read_head(self) -> None:
        count = int(self._own("frames")[()])
        bodies = json.loads(self._file["particles"].attrs["bodies"])
        self.bodies = {name: slice(int(start), int(stop)) for name, (start, stop) in bodies.items()}
        self.fields = tuple(name for name in self._file["particles"] if name != "body")
        particles = max(part.stop for part in self.bodies.values())
        for name in ("time", "step"):
            self._require_room(name, (count,))
        for name in self.fields:
            self._require_room(f"particles/{name}", (count, particles))
        self.time: Array = self._file["time"][:count]
        self.step: Array = self._file["step"][:count]
        self.provenance: dict[str, Any] = json.loads(self._file.attrs["provenance"])

    def _own(self, name: str) -> Any:
        """Return a dataset whose numbers are in this file, and not behind a link in another one."""
        found = self._file[name]
        if found.file != self._file or found.is_virtual or found.external:
            raise ValueError(f"{name} is in another file")
        return found

    def _require_room(self, name: str, shape: tuple[int, ...]) -> None:
        """Refuse a dataset that does not have what others say of it."""
        found = self._own(name).shape
        if len(found) < len(shape) or found[0] < shape[0] or found[1 : len(shape)] != shape[1:]:
            raise ValueError(f"{name} is of shape {found}, and {shape} is needed")

    def __len__(self) -> int:
        return len(self.time)

    def read(self, field: str, frame: int) -> Array:
        """Return a field of every particle in one frame (N, ...); raise a UsageError if it cannot be read."""
        with self._reading():
            return np.asarray(self._file["particles"][field][frame])

    def read_all(self, field: str) -> Array:
        """Return a field in every frame (T, N, ...); raise a UsageError if it cannot be read."""
        with self._reading():
            return np.asarray(self._file["particles"][field][: len(self)])

    def close(self) -> None:
        """Close the file; a second call does nothing."""
        self._file.close()

    def __enter__(self) -> Frames:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # a damaged file may raise anything
            raise UsageError(f"{self.path}: not a cqrun trajectory, or damaged ({error})") from error
