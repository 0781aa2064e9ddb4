"""Read the markers of C3D files, the motion-capture format, with the numbers of Intel, DEC and MIPS processors.

cqrun reads them itself: the libraries for C3D trust what a file claims, and one changed byte ended the process.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, columns, unit_of
from cqrun.plugin.contract import Array
from cqrun.store.formats.c3d_head import Head, read_head, reals
from cqrun.units import METRES


def read_c3d(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read markers of a C3D file; the time of its first frame is 0, whatever number that frame has.

    A marker with a negative residual, or NaN in place of its coordinates, was not seen. `units` overrides POINT:UNITS.

    Raises:
        DataError: the file is not C3D, is damaged or truncated, or has no markers, frame rate or known units.
    """
    data = path.read_bytes()
    head = read_head(data, source)
    if head.points == 0:
        raise DataError(f"{source}: has no markers")
    if head.scale == 0 or not np.isfinite(head.scale):
        raise DataError(f"{source}: the scale of its coordinates (POINT:SCALE) is {head.scale:g}; export it again")
    if not head.rate > 0:
        raise DataError(f"{source}: its frame rate (POINT:RATE) is {head.rate:g}; it must be positive")
    chosen = columns(head.labels, names, source)
    positions = METRES[units or _file_unit(head, source)] * _positions(data, head, chosen, source)
    time = np.arange(len(positions)) / head.rate
    return Recording(time, tuple(head.labels[k] for k in chosen), positions, source)


def _positions(data: bytes, head: Head, chosen: Sequence[int], source: str) -> Array:
    """Return the coordinates of the chosen markers (T, M, 3), NaN where one was not seen."""
    size = 4 if head.scale < 0 else 2
    frame = 4 * head.points + head.analog  # numbers: x, y, z and residual of each marker, then analog samples
    there = max(len(data) - head.start, 0) // (frame * size)
    frames = there if head.frames is None else head.frames
    if there < frames:
        raise DataError(
            f"{source}: truncated: its header promises {frames} frames and {there} are there; copy or export it again"
        )
    raw = np.frombuffer(data, f"{head.order}{'u4' if head.scale < 0 else 'i2'}", frames * frame, head.start)
    markers = raw.reshape(frames, frame)[:, : 4 * head.points].reshape(frames, head.points, 4)[:, list(chosen)]
    numbers = reals(markers, head.processor) if head.scale < 0 else markers.astype(float)
    positions = np.ascontiguousarray(numbers[..., :3])
    positions[np.signbit(numbers[..., 3])] = np.nan
    return positions if head.scale < 0 else head.scale * positions


def _file_unit(head: Head, source: str) -> str:
    """Return the unit in POINT:UNITS."""
    unit = unit_of(head.units)
    if unit is None:
        what = f"are '{head.units}', which is not known" if head.units else "are missing"
        raise DataError(
            f"{source}: the units in the file (POINT:UNITS) {what}; give them with `units: {' | '.join(METRES)}`"
        )
    return unit
