"""Trajectories: HDF5 files that h5py, MATLAB and ParaView can read.

    /time (T) f8   /step (T) i8   /frames () i8: number of written frames
    /particles/x (T, N, D) f8   v (T, N, D) f4   further fields (T, N, ...)   body (N) i4
    /particles/group (N) i4: number of the last group that contains a particle, in the order of the attribute `groups`;
        -1 for none
    /particles attributes: names of the bodies, and first and last particle of each       / attributes: provenance
    /measured: quantities that the scene names, over time (measured.py)
    /rigid: how rigid bodies move (rigid_motion.py)
    /reactions: forces and moments of boundaries, if the run recorded them (reactions.py)
    /checksums/x, v, ... (T) u4: CRC-32 of each frame of a field; without them a damaged index reads as zeros
    /VTKHDF: the same data in ParaView's format, as virtual datasets without a copy (vtkhdf.py)

trajectory.vtkhdf is a small file that links to /VTKHDF. By this ending ParaView and `pyvista.read` know the format.
Datasets have the attributes `unit` and `long_name`.

While a trajectory is written, its name is `<name>.part`. It has contiguous datasets of full size, which are made and
flushed first. Each frame is written in place and flushed, and counted last. So a kill at any moment loses at most that
frame. On closing, the file is packed (gzip, shuffle) into its final name. `libver` keeps the format readable for VTK's
own HDF5.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from cqrun.disk import make_empty, sync_directory
from cqrun.plugin.contract import Array
from cqrun.store.atomic import disk_errors, make_directory, replacing, require_room
from cqrun.store.frames import STANDING, Frames, part_path
from cqrun.store.hdf5 import checksum
from cqrun.store.measured import MeasuredQuantities
from cqrun.store.reactions import Reactions
from cqrun.store.rigid_motion import RigidMotions
from cqrun.store.vtkhdf import add_vtk_view

if TYPE_CHECKING:
    import h5py

LIBVER = ("earliest", "v110")
POSITION, POSITION_TYPE, FIELD_TYPE = "x", "f8", "f4"
CHUNK = 16384
MEANINGS = {
    "time": ("s", "time"),
    "step": ("1", "number of the control step, or of the point of a path"),
    "x": ("m", "position"),
    "v": ("m/s", "velocity"),
    "J": ("1", "volume divided by that at rest, det F"),
    "activation": ("1", "activation of the actuators on the particle"),
    "body": ("1", "number of the body, in the order of the attribute `bodies` of the group"),
    "group": ("1", "number of the last group that contains it, in the order of the attribute `groups`; -1 for none"),
    "strain": ("1", "Green strain: xx, yy, (zz,) xy(, xz, yz)"),
    "stress": ("Pa", "Cauchy stress of the material: xx, yy, (zz,) xy(, xz, yz)"),
}
"""Unit and meaning of datasets, by name."""

SPARE = 1 << 15
"""Largest size of a file besides its data [bytes]."""


@dataclass(frozen=True)
class Trajectory:
    """A trajectory in memory.

    Args:
        time: times of the written frames (T,) [s].
        step: number of the substep or control step of each frame (T,).
        fields: x (T, N, D) [m] and the other fields, (T, N, ...).
        bodies: slice of each body's particles.
        provenance: the attributes given to the writer.
        complete: whether every frame was written and the file closed.
        reactions: of boundaries in every control step; None if the run did not record any.
        measured: quantities that the scene names; None if it names none.
        rigid: how rigid bodies move; None if there are none.
    """

    time: Array
    step: Array
    fields: dict[str, Array]
    bodies: dict[str, slice]
    provenance: dict[str, Any] = field(default_factory=dict)
    complete: bool = True
    reactions: Reactions | None = None
    measured: MeasuredQuantities | None = None
    rigid: RigidMotions | None = None


class Beside(Protocol):
    """What a trajectory holds beside the particles."""

    @property
    def nbytes(self) -> int:
        """Size of all numbers [bytes], with checksums and names."""

    def write_to(self, file: h5py.File) -> None:
        """Write it to the file."""


class TrajectoryWriter:
    """Writes frames one after another; a context manager that closes the file if there was no error.

    Args:
        path: final name; an existing file is kept until `close`.
        n_frames: number of frames that will be written.
        bodies: slice of the particles of each body; together they cover 0 to N.
        dim: 2 or 3.
        fields: shape of each further field after (T, N), such as {"v": (dim,), "activation": ()}.
        groups: indices of the particles of each group, by name.
        provenance: attributes of the file: strings, numbers, or values that JSON can represent.

    Raises:
        UsageError, RunError: the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        n_frames: int,
        bodies: Mapping[str, slice],
        dim: int,
        fields: Mapping[str, Sequence[int]],
        provenance: Mapping[str, Any],
        groups: Mapping[str, Array] = MappingProxyType({}),
    ) -> None:
        self.path, self.part = path, part_path(path)
        self.n_frames, self.written = n_frames, 0
        self._beside: list[Beside] = []
        self._shapes = {POSITION: (dim,)} | {name: tuple(shape) for name, shape in fields.items()}
        make_directory(path.parent)
        self._raw = self._count_bytes(dict(bodies)) + 3 * len(json.dumps(dict(provenance))) + SPARE
        require_room(self.part, self._raw)
        beginning = path.with_name(path.name + ".new")  # renamed once it is readable, because every `.part` must be
        with disk_errors(self.part):
            make_empty(beginning)
            with _open_for_writing(beginning, "w") as file:
                self._lay_out(file, dict(bodies), dict(provenance))
                _add_groups(file, groups)
            beginning.replace(self.part)
            self._file = _open_for_writing(self.part, "r+")

    def write(self, frame_index: int, time: float, **arrays: Array) -> None:
        """Write a frame and count it; after that the frame survives a kill of the process.

        Args:
            frame_index: the next frame, from 0 (a resumed rollout starts with 0 again).
            time: time of the frame [s].
            arrays: every field (N, ...) by name, including x; also `step` (an int) if it is not the frame's number.

        Raises:
            ValueError: a frame out of order, or missing or unknown fields.
            UsageError, RunError: the frame cannot be written.
        """
        step = arrays.pop("step", frame_index)
        if frame_index != self.written or frame_index >= self.n_frames:
            raise ValueError(f"frame {frame_index} of {self.n_frames} after {self.written} frames")
        if arrays.keys() != self._shapes.keys():
            raise ValueError(f"fields {sorted(arrays)}, but the file has {sorted(self._shapes)}")
        with disk_errors(self.part):
            self._file["time"][frame_index] = time
            self._file["step"][frame_index] = step
            for name, array in arrays.items():
                self._file["particles"][name][frame_index] = array
            self._file.flush()
            self._file["frames"][()] = frame_index + 1
            self._file.flush()
        self.written += 1

    def add(self, beside: Beside) -> None:
        """Add what is known only at the end of a run, such as the reactions of boundaries; `close` writes it."""
        self._beside.append(beside)
        self._raw += beside.nbytes

    def close(self) -> None:
        """Pack the file into its final name, and add the view for ParaView; a second call does nothing.

        Raises:
            UsageError, RunError: the file cannot be written; the `.part` remains.
        """
        if not self._file:
            return
        packed = self.path.with_name(self.path.name + ".packing")
        require_room(packed, self._raw + self._raw // 50 + SPARE)  # in case nothing can be compressed
        with disk_errors(self.path):
            make_empty(packed)
            with _open_for_writing(packed, "w") as target:
                _pack(self._file, target, self.written)
                for beside in self._beside:
                    beside.write_to(target)
            self._file.close()
            packed.replace(self.path)
            self.part.unlink()
            _link_for_vtk(self.path)
            sync_directory(self.path.parent)

    def abandon(self) -> None:
        """Close the file and keep the readable `.part`."""
        self._file.close()

    def __enter__(self) -> TrajectoryWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self.abandon()

    def _count_bytes(self, bodies: dict[str, slice]) -> int:
        """Return the size of all datasets [bytes], including the view for ParaView."""
        count = max(part.stop for part in bodies.values())
        a_particle = sum(
            np.dtype(POSITION_TYPE if name == POSITION else FIELD_TYPE).itemsize * int(np.prod(shape, dtype=int))
            for name, shape in self._shapes.items()
        )
        return self.n_frames * (count * a_particle + 256) + 40 * count

    def _lay_out(self, file: h5py.File, bodies: dict[str, slice], provenance: dict[str, Any]) -> None:
        count = max(part.stop for part in bodies.values())
        _make_contiguous(file, "time", (self.n_frames,), "f8")
        _make_contiguous(file, "step", (self.n_frames,), "i8")
        _make_contiguous(file, "frames", (), "i8")
        for name, shape in self._shapes.items():
            kind = POSITION_TYPE if name == POSITION else FIELD_TYPE
            _make_contiguous(file, f"particles/{name}", (self.n_frames, count, *shape), kind)
        body = np.zeros(count, "i4")
        for number, part in enumerate(bodies.values()):
            body[part] = number
        file["particles/body"] = body
        file["particles"].attrs["bodies"] = json.dumps({n: [p.start, p.stop] for n, p in bodies.items()})
        file.attrs["format"] = "cqrun trajectory 1"
        file.attrs["provenance"] = json.dumps(provenance)
        for name, value in provenance.items():
            file.attrs[name] = value if isinstance(value, str | int | float) else json.dumps(value)


def _add_groups(file: h5py.File, groups: Mapping[str, Array]) -> None:
    """Write the number of the last group that contains each particle, and the names of the groups."""
    number = np.full(len(file["particles/body"]), -1, "i4")
    for k, members in enumerate(groups.values()):
        number[members] = k
    file["particles/group"] = number
    file["particles"].attrs["groups"] = json.dumps(list(groups))


def _link_for_vtk(path: Path) -> None:
    """Write a small file beside a trajectory that links to its view for ParaView, and is named as pyvista expects."""
    import h5py

    with replacing(path.with_suffix(".vtkhdf")) as beside, _open_for_writing(beside, "w") as file:
        file["VTKHDF"] = h5py.ExternalLink(path.name, "/VTKHDF")


def _open_for_writing(path: Path, mode: str) -> h5py.File:
    import h5py

    return h5py.File(path, mode, libver=LIBVER, locking=False)  # the run is locked, where the file system has locks


def _make_contiguous(file: h5py.File, name: str, shape: tuple[int, ...], kind: str) -> None:
    """Make a dataset whose disk space is allocated now, so that later writes do not change metadata."""
    import h5py

    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.CONTIGUOUS)
    layout.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    layout.set_fill_time(h5py.h5d.FILL_TIME_ALLOC)  # a disk that is too small fails here
    space = h5py.h5s.create_simple(shape) if shape else h5py.h5s.create(h5py.h5s.SCALAR)
    parent, _, leaf = name.rpartition("/")
    group = file.require_group(parent) if parent else file
    h5py.h5d.create(group.id, leaf.encode(), h5py.h5t.py_create(np.dtype(kind)), space, dcpl=layout)


def _pack(source: h5py.File, target: h5py.File, frames: int) -> None:
    """Copy and compress the written frames, and add the view for ParaView."""
    target.attrs.update(source.attrs)
    for name in ("time", "step"):
        target[name] = source[name][:frames]
    target["frames"] = np.int64(frames)
    particles = target.create_group("particles")
    particles.attrs.update(source["particles"].attrs)
    for name in STANDING:
        particles[name] = source[f"particles/{name}"][()]
    for name, data in source["particles"].items():
        if name in STANDING:
            continue
        packed = particles.create_dataset(
            name,
            shape=(frames, *data.shape[1:]),
            dtype=data.dtype,
            chunks=(1, min(data.shape[1], CHUNK), *data.shape[2:]) if frames else None,
            compression="gzip" if frames else None,
            compression_opts=1 if frames else None,
            shuffle=bool(frames),
        )
        sums = np.zeros(frames, np.uint32)
        for frame in range(frames):
            packed[frame] = values = data[frame]
            sums[frame] = checksum(values)
        target[f"checksums/{name}"] = sums
    for data in (target["time"], target["step"], *particles.values()):
        unit, meaning = MEANINGS.get(data.name.rpartition("/")[2], ("", ""))
        if unit:
            data.attrs["unit"], data.attrs["long_name"] = unit, meaning
    if frames:
        add_vtk_view(target)


def read_trajectory(path: Path) -> Trajectory:
    """Read all written frames of a trajectory, also if another process is writing it or it is incomplete.

    Args:
        path: the final name or that of the `.part`; if only the `.part` exists, it is read.

    Raises:
        UsageError: there is no trajectory, or it cannot be read.
    """
    with Frames(path) as frames:
        return Trajectory(
            time=frames.time,
            step=frames.step,
            fields={name: frames.read_all(name) for name in frames.fields},
            bodies=frames.bodies,
            provenance=frames.provenance,
            complete=frames.complete,
            reactions=frames.read_reactions(),
            measured=frames.read_measured(),
            rigid=frames.read_rigid(),
        )
