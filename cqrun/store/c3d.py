"""Read C3D files, the motion-capture format, with ezc3d.

ezc3d silently shortens a truncated file and never returns from one that ends inside its parameters. Therefore the
header is compared with the size of the file first.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, unit_of
from cqrun.plugin.contract import Array
from cqrun.units import METRES

BLOCK = 512
_MAGIC = 0x50
_BYTE_ORDER = {84: "<", 85: "<", 86: ">"}  # Intel, DEC, MIPS
_LONG = 0xFFFF


def read_c3d(path: Path, units: str | None, source: str) -> Recording:
    """Read the markers of a C3D file; the time of its first frame is 0.

    A marker with a negative residual or a NaN coordinate was not seen. `units` overrides POINT:UNITS.

    Raises:
        DataError: the file is not C3D, is truncated, or has no markers, frame rate or known units.
    """
    promised = _promised_frames(path.read_bytes(), source)
    import ezc3d

    try:
        content: Any = ezc3d.c3d(str(path))
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise DataError(f"{source}: cannot be read as a C3D file ({error})") from error
    point = content["parameters"]["POINT"]
    points = np.asarray(content["data"]["points"], dtype=float)
    promised = max(promised, int(_first(point, "LONG_FRAMES", 0)))
    if points.shape[2] < promised:
        raise DataError(
            f"{source}: truncated: its header promises {promised} frames and "
            f"{points.shape[2]} are there; copy or export it again"
        )
    if points.shape[1] == 0:
        raise DataError(f"{source}: has no markers")
    rate = float(_first(point, "RATE", 0.0))
    if not rate > 0:
        raise DataError(f"{source}: its frame rate (POINT:RATE) is {rate:g}; it must be positive")
    positions = _positions(points, content["data"]["meta_points"]["residuals"])
    scale = METRES[units or _file_unit(point, source)]
    time = np.arange(positions.shape[0]) / rate
    return Recording(time, _labels(point, positions.shape[1]), scale * positions, source)


def _promised_frames(data: bytes, source: str) -> int:
    """Return the number of frames in the header; refuse a file that is not C3D or ends before its data."""
    first = data[0] if data else 0
    if len(data) < 2 or data[1] != _MAGIC or first < 2:
        raise DataError(f"{source}: not a C3D file (its second byte is not 0x50)")
    start = (first - 1) * BLOCK
    if len(data) < start + 4:
        raise DataError(f"{source}: truncated: the file ends before its parameters; copy or export it again")
    blocks, processor = data[start + 2], data[start + 3]
    if processor not in _BYTE_ORDER:
        raise DataError(f"{source}: not a C3D file (processor type {processor} is not 84, 85 or 86)")
    if len(data) < start + blocks * BLOCK:
        raise DataError(f"{source}: truncated: the file ends inside its parameters; copy or export it again")
    first_frame, last_frame = struct.unpack(_BYTE_ORDER[processor] + "HH", data[6:10])
    # The header cannot count more than 65,534 frames; then POINT:LONG_FRAMES is compared with the data instead.
    return 0 if last_frame == _LONG else max(last_frame - first_frame + 1, 0)


def _positions(points: Array, residuals: Array) -> Array:
    """Return (T, M, 3) with NaN where a marker was not seen, from ezc3d's (4, M, T) and (1, M, T)."""
    positions = np.ascontiguousarray(points[:3].transpose(2, 1, 0))
    lost = np.isnan(positions).any(axis=2) | (np.asarray(residuals)[0].T < 0)
    positions[lost] = np.nan
    return positions


def _file_unit(point: dict[str, Any], source: str) -> str:
    """Return the unit in POINT:UNITS."""
    text = str(_first(point, "UNITS", ""))
    unit = unit_of(text)
    if unit is None:
        raise DataError(
            f"{source}: the units in the file (POINT:UNITS) are '{text}', which is not known; "
            f"give them with `units: {' | '.join(METRES)}`"
        )
    return unit


def _labels(point: dict[str, Any], count: int) -> tuple[str, ...]:
    """Return the labels of all markers; files with more than 255 continue in LABELS2, LABELS3, ..."""
    labels: list[str] = []
    for suffix in ("", *(str(i) for i in range(2, 2 + count // 255 + 1))):
        labels += [str(label).strip() for label in point.get(f"LABELS{suffix}", {}).get("value", [])]
    labels = labels[:count]
    return (*labels, *(f"unlabelled {i}" for i in range(len(labels), count)))


def _first(point: dict[str, Any], key: str, default: Any) -> Any:
    """Return the first value of a parameter, or `default` if it is absent or empty."""
    value = point.get(key, {}).get("value", [])
    return value[0] if len(value) else default
