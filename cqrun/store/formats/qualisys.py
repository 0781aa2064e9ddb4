"""TSV files of Qualisys Track Manager with 3D data.

    NO_OF_FRAMES	500
    NO_OF_MARKERS	2
    FREQUENCY	100
    DATA_INCLUDED	3D
    MARKER_NAMES	tip	base
    Frame	Time	tip X	tip Y	tip Z	...     may be absent, as a whole or the first two columns
    1	0.00000	140.020	45.100	126.300	...

Positions are in millimetres. A marker is not seen where its cells are empty or all three are 0. The header is described
at https://docs.qualisys.com/qtm/content/processing_measurement/motion_data_tsv.htm; the lines after it are as in files
that QTM has exported.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, columns
from cqrun.plugin.contract import Array
from cqrun.store.formats.cells import MISSING
from cqrun.store.formats.frames import Frames, Layout, read_frames, require_frames, require_rate, require_same_clock
from cqrun.store.formats.text import lines_of, number_in, split, stripped

BEGINS = re.compile(r"(FILE_VERSION|NO_OF_FRAMES|NO_OF_CAMERAS|NO_OF_MARKERS)\t")

_KEY = re.compile(r"[A-Z][A-Z0-9]*(_[A-Z0-9]+)*")
_AGAIN = "export the measurement as 3D data with its header, or as C3D"


def read_qualisys(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read the markers of a TSV file of Qualisys.

    Times are those in the file if it has a column of them; if not, the time of its first frame is 0.

    Raises:
        DataError: the header or a line is wrong; the message names it and what would be right.
    """
    lines = lines_of(path, source)
    claims, rest = _header(lines)
    if (kind := claims.get("DATA_INCLUDED", (0, ["missing"]))[1][0]) != "3D":
        raise DataError(f"{source}: its data (DATA_INCLUDED) are {kind[:40]}, not 3D: {_AGAIN}")
    labels = _names(claims, source)
    layout, columns_line = _layout(labels, rest, source)
    layout = layout.of(columns(labels, names, source))
    rest = [] if columns_line else rest
    frames = read_frames(chain(rest, lines), layout, "\t", source)
    frames.positions[(frames.positions == 0).all(axis=2)] = np.nan
    require_frames(len(frames.lines), _claim(claims, "NO_OF_FRAMES"), source)
    return frames.recording(_time(frames, claims, source), units or "mm", layout.names, source)


Claims = dict[str, tuple[int, list[str]]]
"""Line and values of every key."""


def _header(lines: Iterator[tuple[int, str]]) -> tuple[Claims, list[tuple[int, str]]]:
    """Return what the header says, and the first line after it."""
    claims: Claims = {}
    for number, line in lines:
        key, *values = stripped(split(line, "\t"))
        if _KEY.fullmatch(key) and values and key.lower() not in MISSING:
            claims[key] = number, values
        elif line.strip():
            return claims, [(number, line)]
    return claims, []


def _claim(claims: Claims, key: str) -> float | None:
    return number_in(claims[key][1][0]) if key in claims else None


def _names(claims: Claims, source: str) -> tuple[str, ...]:
    """Return the names of the markers."""
    line, names = claims.get("MARKER_NAMES", (0, []))
    names = names[: max((k for k, name in enumerate(names, 1) if name), default=0)]
    if not names:
        raise DataError(f"{source}: has no markers (MARKER_NAMES): {_AGAIN}")
    count = _claim(claims, "NO_OF_MARKERS")
    if count is not None and count != len(names):
        raise DataError(
            f"{source}:{line}: names {len(names)} markers (MARKER_NAMES), and NO_OF_MARKERS is {count:g}: the file is "
            "damaged; copy or export it again"
        )
    return tuple(name or f"unlabelled {k}" for k, name in enumerate(names))


def _layout(names: Sequence[str], first: Sequence[tuple[int, str]], source: str) -> tuple[Layout, bool]:
    """Return where the first line after the header has what, and whether it names the columns."""
    if not first:
        raise DataError(f"{source}: has a header but no data")
    number, line = first[0]
    cells = stripped(split(line, "\t"))
    count = 3 * len(names)
    words = [cell.lower() for cell in cells[:2]]
    named = not any(number_in(cell) is not None for cell in cells) and any(
        cell.lower() not in MISSING for cell in cells
    )
    if named:
        before = next((k for k, word in enumerate(words) if word not in ("frame", "time")), 2)
        clock = words[:before].index("time") if "time" in words[:before] else None
    else:
        extra = len(cells) - count
        before = extra - (1 if extra > 0 and not cells[-1] and cells[-2] else 0)  # a tab may end each line
        clock = 1 if before == 2 else None
        if before not in (0, 1, 2) or (before == 1 and not any(cells[-3:])):
            raise DataError(
                f"{source}:{number}: has {len(cells)} columns, and {len(names)} markers have {count}: {_AGAIN}, and "
                "with the names of the columns"
            )
    places = tuple(tuple(range(k, k + 3)) for k in range(before, before + count, 3))
    return Layout(tuple(names), places, before + count, clock), named


def _time(frames: Frames, claims: Claims, source: str) -> Array:
    """Return the times of the frames (T,) [s]."""
    line, values = claims.get("FREQUENCY", (0, [""]))
    rate = number_in(values[0])
    if frames.clock is None:
        return np.arange(len(frames.lines)) / require_rate(rate, values[0], f"{source}:{line} (FREQUENCY)")
    require_same_clock(frames.clock, rate, source)
    return frames.clock
