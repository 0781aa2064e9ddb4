"""Reading recordings: what a camera system, another program or cqrun itself saw, in metres and seconds.

`read_recording` tells the formats apart by the file's ending: C3D, CSV (`time,marker,x,y,z`) and
cqrun's own trajectories (HDF5). Whatever cannot be used is refused with a `DataError` that says what to do.
"""

from __future__ import annotations

from pathlib import Path

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, check_recording
from cqrun.plugin.contract import Array
from cqrun.store.c3d import read_c3d
from cqrun.store.marker_csv import read_csv
from cqrun.store.recorded_trajectory import read_trajectory
from cqrun.units import METRES


def read_recording(path: Path, *, units: str | None = None, where: str = "") -> Recording:
    """Read a recording, whatever its format.

    Args:
        path: a `.c3d`, `.csv` or `.h5` file.
        units: `m`, `cm` or `mm`; None takes what a C3D file says of itself, and metres otherwise.
        where: key path of the recording in the scene, put in front of every message.

    Raises:
        DataError: the file is missing, empty, truncated, of another format, or holds what no
            recording can (times that do not increase, infinite or half-missing positions).
    """
    path = Path(path)
    source = f"{where}: {path}" if where else str(path)
    readers = {".c3d": read_c3d, ".csv": read_csv, ".h5": read_trajectory}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise DataError(f"{source}: a recording ends in {', '.join(readers)}, not in '{path.suffix}'")
    if units is not None and units not in METRES:
        raise DataError(f"{source}: units '{units}' are not known; use {', '.join(METRES)}")
    if not path.is_file():
        raise DataError(f"{source}: there is no such file")
    try:
        if path.stat().st_size == 0:
            raise DataError(f"{source}: the file is empty")
        recording = reader(path, units, source)
    except OSError as error:
        raise DataError(f"{source}: cannot be read: {error.strerror or error}") from error
    return check_recording(recording)


def marker_path(path: Path, units: str | None, marker: str) -> tuple[Array, Array]:
    """Return the times (T,) [s] at which a marker was seen, and where it was (T, D) [m]; errors as `read_recording`."""
    recording = read_recording(path, units=units).select([marker])
    seen = recording.seen()[:, 0]
    return recording.time[seen], recording.positions[seen, 0]
