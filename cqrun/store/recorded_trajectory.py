"""Read a trajectory of cqrun as a recording: every particle is a marker, named by its index."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording
from cqrun.units import METRES


def read_trajectory(path: Path, units: str | None, source: str) -> Recording:
    """Read `/time` (T,) and `/particles/x` (T, N, D) of a trajectory file.

    Raises:
        DataError: the file is not HDF5, is truncated, lacks one of the two datasets, or has positions that are not
            finite.
    """
    import h5py

    try:
        with h5py.File(path, "r", locking=False) as file:
            missing = [name for name in ("time", "particles/x") if not isinstance(file.get(name), h5py.Dataset)]
            if missing:
                raise DataError(f"{source}: no dataset /{missing[0]}; is it a trajectory.h5 of a finished run?")
            time = np.asarray(file["time"][()], dtype=float)
            positions = np.asarray(file["particles/x"][()], dtype=float)
    except OSError as error:
        raise DataError(f"{source}: not an HDF5 file, or truncated ({error})") from error
    if time.ndim != 1 or positions.ndim != 3 or positions.shape[0] != time.size or positions.shape[2] not in (2, 3):
        raise DataError(
            f"{source}: /time {time.shape} and /particles/x {positions.shape} do not fit together; "
            "they should be (T,) and (T, N, D)"
        )
    if not np.isfinite(positions).all():
        frame, particle, _ = (int(i[0]) for i in np.nonzero(~np.isfinite(positions)))
        raise DataError(f"{source}: particle {particle} is not finite in frame {frame}")
    names = tuple(str(i) for i in range(positions.shape[1]))
    return Recording(time, names, METRES[units or "m"] * positions, source)
