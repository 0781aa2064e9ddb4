"""Read recordings of a camera system, of another program or of cqrun itself, in metres and seconds.

`read_recording` selects the format by the end of the file's name: C3D, text, or a trajectory of cqrun (HDF5). Of text
the beginning tells which program wrote it. A file that cannot be used is refused with a `DataError` that says what to
do. docs/recordings.md has an example of every format.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.plausible import plausible
from cqrun.measurements.recording import Recording, check_recording
from cqrun.plugin.contract import Array
from cqrun.store.formats import motive, qualisys, trc, vicon
from cqrun.store.formats.c3d import read_c3d
from cqrun.store.formats.long_table import is_long, read_long
from cqrun.store.formats.text import beginning, header_of
from cqrun.store.formats.trajectory import read_trajectory
from cqrun.store.formats.unreadable import other_format
from cqrun.store.formats.wide_table import read_wide
from cqrun.units import METRES

Reader = Callable[[Path, str | None, str, Sequence[str] | None], Recording]

TEXT = (".csv", ".tsv", ".txt", ".trc")
"""How the name of a recording ends that is text."""

_PROGRAMS: tuple[tuple[re.Pattern[str], Reader], ...] = (
    (motive.BEGINS, motive.read_motive),
    (vicon.BEGINS, vicon.read_vicon),
    (qualisys.BEGINS, qualisys.read_qualisys),
    (trc.BEGINS, trc.read_trc),
)
"""How text of other programs begins."""


def read_recording(
    path: Path, *, units: str | None = None, where: str = "", names: Sequence[str] | None = None
) -> Recording:
    """Read a recording in any of the formats.

    Args:
        path: a `.c3d`, `.csv`, `.tsv`, `.txt`, `.trc` or `.h5` file.
        units: `m`, `cm` or `mm`; None means the units that the file gives, and metres otherwise.
        where: key path of the recording in the scene; every message begins with it.
        names: the markers to read, in this order; None means all.

    Raises:
        DataError: the file is missing, empty, truncated or of another format, or its content is not valid (times that
            do not increase, infinite or half-missing positions), or a marker is not in it.
    """
    path = Path(path)
    source = f"{where}: {path}" if where else str(path)
    readers: dict[str, Reader] = {".c3d": read_c3d, **dict.fromkeys(TEXT, _read_text), ".h5": read_trajectory}
    reader = readers.get(path.suffix.lower())
    if units is not None and units not in METRES:
        raise DataError(f"{source}: units '{units}' are not known; use {', '.join(METRES)}")
    if not path.is_file():
        raise DataError(f"{source}: {'not a regular file' if path.exists() else 'there is no such file'}")
    try:
        if reader is None:
            ending = f"the name of a recording ends in {', '.join(readers)}, not in '{path.suffix}'"
            raise DataError(f"{source}: {other_format(path) or ending}")
        if path.stat().st_size == 0:
            raise DataError(f"{source}: the file is empty")
        recording = reader(path, units, source, names)
    except OSError as error:
        raise DataError(f"{source}: cannot be read: {error.strerror or error}") from error
    return check_recording(recording)


def _read_text(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read text in the format that its beginning tells."""
    start = beginning(path)
    reader = next((reader for begins, reader in _PROGRAMS if begins.match(start)), None)
    if reader is None:
        reader = read_long if is_long(header_of(path, source)[1]) else read_wide
    return reader(path, units, source, names)


def marker_path(path: Path, units: str | None, marker: str) -> tuple[Array, Array]:
    """Return the times (T,) [s] and positions (T, D) [m] at which a marker was seen, as it is not at exact zeros.

    Raises as `read_recording`.
    """
    recording, _ = plausible(read_recording(path, units=units, names=[marker]), np.inf, (-np.inf, np.inf))
    seen = recording.seen()[:, 0]
    return recording.time[seen], recording.positions[seen, 0]
