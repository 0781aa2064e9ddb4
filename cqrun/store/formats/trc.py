"""TRC files (Track Row Column) of Motion Analysis Cortex, OpenSim and other programs.

    PathFileType	4	(X/Y/Z)	beam.trc
    DataRate	CameraRate	NumFrames	NumMarkers	Units	OrigDataRate	OrigDataStartFrame	OrigNumFrames
    100	100	2	2	mm	100	1	2
    Frame#	Time	tip			base			in every third column
                X1	Y1	Z1	X2	Y2	Z2

    1	0.000	140.02	45.1	126.3	46	20	89

The format is described at https://opensimconfluence.atlassian.net/wiki/spaces/OpenSim/pages/53089972.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, columns
from cqrun.store.formats.frames import (
    Layout,
    read_frames,
    require_frames,
    require_same_clock,
    require_unit,
)
from cqrun.store.formats.text import is_blank, lines_of, number_in, split, stripped

BEGINS = re.compile(r"PathFileType\s")


def read_trc(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read the markers of a TRC file; times are those in the file, and empty cells were not seen.

    `units` overrides the unit in the file.

    Raises:
        DataError: the header or a line is wrong; the message names it and what would be right.
    """
    lines = lines_of(path, source)
    written = ((number, line) for number, line in lines if not is_blank(line))
    head = [(number, stripped(split(line, "\t"))) for number, line in islice(written, 5)]
    if len(head) < 5:
        raise DataError(f"{source}: the file ends in its header; copy or export it again")
    _, (_, keys), (at, values), (at_names, labels), (at_axes, axes) = head
    claims = dict(zip(keys, values, strict=False))
    markers = _markers(labels, claims, f"{source}:{at_names}")
    _require_axes(axes, len(markers), f"{source}:{at_axes}")
    places = tuple((k, k + 1, k + 2) for k in range(2, 2 + 3 * len(markers), 3))
    layout = Layout(markers, places, 2 + 3 * len(markers), 1).of(columns(markers, names, source))
    unit = units or require_unit(claims.get("Units", ""), f"{source}:{at}")
    frames = read_frames(lines, layout, "\t", source)
    assert frames.clock is not None
    require_frames(len(frames.lines), number_in(claims.get("NumFrames", "")), source)
    require_same_clock(frames.clock, number_in(claims.get("DataRate", "")), source)
    return frames.recording(frames.clock, unit, layout.names, source)


def _markers(labels: Sequence[str], claims: dict[str, str], at: str) -> tuple[str, ...]:
    """Return the names of the markers, between which cells are empty."""
    if [label.lower() for label in labels[:2]] != ["frame#", "time"]:
        raise DataError(
            f"{at}: must be 'Frame#', 'Time' and the names of the markers, with tabs between them; is "
            f"'{' '.join(labels)[:60]}'"
        )
    names = tuple(label for label in labels[2:] if label)
    count = number_in(claims.get("NumMarkers", ""))
    if not names or count is None or count != len(names):
        raise DataError(
            f"{at}: names {len(names)} markers, and NumMarkers is '{claims.get('NumMarkers', '')[:40]}': each name "
            "stands above the first of its three columns"
        )
    return names


def _require_axes(axes: Sequence[str], count: int, at: str) -> None:
    """Refuse other coordinates than x, y and z of each marker."""
    found = [axis[:1].upper() for axis in axes if axis]
    if found != ["X", "Y", "Z"] * count:
        raise DataError(f"{at}: must be X1, Y1, Z1, X2, ... for {count} markers; is '{' '.join(axes)[:60]}'")
