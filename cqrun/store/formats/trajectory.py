"""Read a trajectory of cqrun as a recording: every particle is a marker, named by its index."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, columns
from cqrun.plugin.contract import Array
from cqrun.store.hdf5 import UNREADABLE, blocks, member, numbers, require_sound_heaps
from cqrun.units import METRES

if TYPE_CHECKING:
    import h5py


def read_trajectory(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read `/time` (T,) and the named particles of `/particles/x` (T, N, D) of a trajectory file.

    Raises:
        DataError: the file is not HDF5, is damaged or truncated, lacks one of the two datasets or a particle, or has
            positions that are not finite.
    """
    import h5py

    try:
        require_sound_heaps(path)
        with h5py.File(path, "r", locking=False) as file:
            missing = [name for name in ("time", "particles/x") if member(file, name) is None]
            if missing:
                raise DataError(f"{source}: no dataset /{missing[0]}; is it a trajectory.h5 of a finished run?")
            clock, x = numbers(file, "time"), numbers(file, "particles/x")
            _require_shapes(clock.shape, x.shape, source)
            chosen = _chosen(names, x.shape[1], source)
            time, positions = np.asarray(clock[()], dtype=float), _positions(x, chosen)
    except UNREADABLE as error:
        raise DataError(f"{source}: not an HDF5 file, damaged or truncated ({error})") from error
    if not np.isfinite(positions).all():
        frame, marker, _ = (int(i[0]) for i in np.nonzero(~np.isfinite(positions)))
        raise DataError(f"{source}: particle {chosen[marker]} is not finite in frame {frame}")
    return Recording(time, tuple(map(str, chosen)), METRES[units or "m"] * positions, source)


def _require_shapes(time: tuple[int, ...], x: tuple[int, ...], source: str) -> None:
    if len(time) != 1 or len(x) != 3 or x[0] != time[0] or x[2] not in (2, 3):
        raise DataError(
            f"{source}: /time {time} and /particles/x {x} do not fit together; they should be (T,) and (T, N, D)"
        )


def _chosen(names: Sequence[str] | None, count: int, source: str) -> Sequence[int]:
    """Return the indices of the named particles; of all for None."""
    if names is None:
        return range(count)
    if not names:
        columns([str(index) for index in range(min(count, 9))], names, source)  # raises
    for name in names:
        if not (name.isdecimal() and len(name) <= len(str(count)) and name == str(int(name)) and int(name) < count):
            raise DataError(
                f"{source}: no marker '{name}': the markers of a trajectory are its particles, '0' to '{count - 1}'"
            )
    return [int(name) for name in names]


def _positions(x: h5py.Dataset, chosen: Sequence[int]) -> Array:
    """Return the positions of particles (T, M, D)."""
    positions = np.empty((x.shape[0], len(chosen), x.shape[2]))
    for part, block in blocks(x):
        with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged file
            positions[part] = block[:, list(chosen)]
    return positions
