"""Read a trajectory of any length frame by frame; store/trajectory.py describes the file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from cqrun.disk import require_ordinary
from cqrun.errors import UsageError
from cqrun.plugin.contract import Array
from cqrun.store.hdf5 import checksum, numbers, require_sound_heaps, require_stored_zeros, text
from cqrun.store.measured import MeasuredQuantities, read_measured
from cqrun.store.reactions import Reactions, read_reactions
from cqrun.store.rigid_motion import RigidMotions, read_rigid

if TYPE_CHECKING:
    import h5py


def part_path(path: Path) -> Path:
    """Return the name of a trajectory while it is being written."""
    return path.with_name(path.name + ".part")


STANDING = ("body", "group")
"""Fields of particles that do not change."""


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
        self._checked: dict[str, h5py.Dataset] = {}
        require_ordinary(self.path)
        with self._reading():
            require_sound_heaps(self.path)
            self._file = h5py.File(self.path, "r", locking=False)  # also while a writer has it open
        try:
            with self._reading():
                self._read_head()
        except UsageError:
            self.close()
            raise
        self.complete = self.path.suffix != ".part"

    def _read_head(self) -> None:
        count = int(numbers(self._file, "frames")[()])
        particles = self._file["particles"]
        bodies = json.loads(text(particles, "bodies"))
        self.bodies = {name: slice(int(start), int(stop)) for name, (start, stop) in bodies.items()}
        self.fields = tuple(name for name in particles if name not in STANDING)
        last = max(part.stop for part in self.bodies.values())
        for name in self.fields:
            _require_room(self._field(name), (count, last))
        for name in ("time", "step"):
            _require_room(numbers(self._file, name), (count,))
        self.time: Array = self._file["time"][:count]
        self.step: Array = self._file["step"][:count]
        self.provenance: dict[str, Any] = dict(json.loads(text(self._file, "provenance")))

    def __len__(self) -> int:
        return len(self.time)

    def read(self, field: str, frame: int) -> Array:
        """Return a field of every particle in one frame (N, ...); raise a UsageError if it cannot be read."""
        with self._reading():
            return self._sound(field, frame, np.asarray(self._field(field)[frame])[None])[0]

    def read_all(self, field: str) -> Array:
        """Return a field in every frame (T, N, ...); raise a UsageError if it cannot be read."""
        with self._reading():
            return self._sound(field, 0, np.asarray(self._field(field)[: len(self)]))

    def read_reactions(self) -> Reactions | None:
        """Return the reactions of boundaries; None if there are none, as in a file that is still being written.

        Raises:
            UsageError: they cannot be read.
        """
        with self._reading():
            return read_reactions(self._file)

    def read_rigid(self) -> RigidMotions | None:
        """Return the motion of rigid bodies; None if there are none, as in a file that is still being written.

        Raises:
            UsageError: it cannot be read.
        """
        with self._reading():
            return read_rigid(self._file)

    def read_measured(self) -> MeasuredQuantities | None:
        """Return the measured quantities; None if there are none, as in a file that is still being written.

        Raises:
            UsageError: they cannot be read.
        """
        with self._reading():
            return read_measured(self._file)

    def _sound(self, field: str, first: int, frames: Array) -> Array:
        """Return frames that were read (T, N, ...), from number `first` on, if they are those that were written."""
        if "checksums" not in self._file:  # of an earlier version, or still being written
            require_stored_zeros(self._field(field), first, frames)
            return frames
        sums = numbers(self._file, f"checksums/{field}")[:]
        if len(sums) != len(self):
            raise ValueError(f"it announces {len(self)} frames of {len(sums)}")
        for number, frame in enumerate(frames, first):
            if checksum(frame) != sums[number]:
                raise ValueError(f"frame {number} of '{field}' is not what was written")
        return frames

    def _field(self, name: str) -> h5py.Dataset:
        """Return the dataset of a field, its size checked once."""
        if name not in self._checked:
            self._checked[name] = numbers(self._file["particles"], name)
        return self._checked[name]

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


def _require_room(data: h5py.Dataset, shape: tuple[int, ...]) -> None:
    """Refuse a dataset that does not have the frames and particles that the file announces."""
    found = data.shape
    if len(found) < len(shape) or found[0] < shape[0] or found[1 : len(shape)] != shape[1:]:
        raise ValueError(f"'{data.name}' is of shape {found}, and {shape} is needed")
