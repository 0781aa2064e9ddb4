"""CSV files of OptiTrack Motive, from format version 1.2 on.

    Format Version,1.23,Take Name,beam,Export Frame Rate,120.000000,Total Exported Frames,2,Length Units,Meters,...

    ,Type,Rigid Body,Rigid Body,...,Marker,Marker,Marker            in older versions without the words
    ,Name,clamp,clamp,...,arm:tip,arm:tip,arm:tip                   Type, Name, ID and Parent
    ,ID,...
    ,,Rotation,Rotation,...,Position,Position,Position
    Frame,Time (Seconds),X,Y,...,X,Y,Z
    0,0.000000,...

A cell of an occluded marker is empty. Columns of the types `Rigid Body Marker` and `Bone Marker` are where Motive
expects markers, even if they are occluded, so they are no measurements and are not read. The format is described at
https://docs.optitrack.com/motive/data-export/data-export-csv.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from cqrun.errors import DataError
from cqrun.explain import listed
from cqrun.measurements.recording import Recording, columns
from cqrun.store.formats.frames import Layout, read_frames, require_frames, require_same_clock, require_unit
from cqrun.store.formats.text import after, is_blank, lines_of, number_in, split, stripped

BEGINS = re.compile(r'"?Format Version"?\s*,')

MEASURED = ("marker", "unlabeled marker", "labeled marker")
"""Types of columns with measured markers."""

SOLVED = "rigid body"
"""Type of columns with the position of a rigid body, which Motive finds from its measured markers."""

_HEADER = 12
"""The header has no more lines."""


def read_motive(path: Path, units: str | None, source: str, names: Sequence[str] | None = None) -> Recording:
    """Read the markers and the positions of rigid bodies of a file of Motive, in the axes of the file.

    `units` overrides the unit in the file. Times are those in the file.

    Raises:
        DataError: the header or a line is wrong; the message names it and what would be right.
    """
    rows = [(number, stripped(split(line, ","))) for number, line in islice(lines_of(path, source), _HEADER)
            if not is_blank(line)]  # fmt: skip
    claims = dict(zip(rows[0][1], rows[0][1][1:], strict=False))  # of every word, what follows it
    last = next((k for k, (_, row) in enumerate(rows) if _is_axes(row)), None)
    if last is None or last < 4:
        raise DataError(
            f"{source}: a CSV file of OptiTrack Motive without the lines that name its columns: export it again with "
            "`Header information`"
        )
    head = [row for _, row in rows[1 : last + 1]]
    layout = _layout(head, source)
    layout = layout.of(columns(layout.names, names, source))
    unit = units or require_unit(claims.get("Length Units", ""), f"{source}:{rows[0][0]}")
    frames = read_frames(after(path, source, rows[last][0]), layout, ",", source)
    assert frames.clock is not None
    require_frames(len(frames.lines), number_in(claims.get("Total Exported Frames", "")), source)
    require_same_clock(frames.clock, number_in(claims.get("Export Frame Rate", "")), source)
    return frames.recording(frames.clock, unit, layout.names, source)


def _is_axes(row: Sequence[str]) -> bool:
    return len(row) > 2 and row[0].lower() == "frame" and row[1].lower().startswith("time")


def _layout(head: Sequence[Sequence[str]], source: str) -> Layout:
    """Return where the measured positions are, from the lines that name the columns."""
    width = max(len(row) for row in head)
    full = [[*row, *[""] * (width - len(row))] for row in head]
    named = {row[1].lower() or row[0].lower(): row for row in full}
    types, labels, roles, axes = named.get("type", full[0]), named.get("name", full[1]), full[-2], full[-1]
    markers: dict[str, list[tuple[str, tuple[int, ...]]]] = {"measured": [], "solved": []}
    for k in range(2, width - 2):
        here = slice(k, k + 3)
        is_point = [axis.upper() for axis in axes[here]] == ["X", "Y", "Z"]
        if is_point and {role.lower() for role in roles[here]} == {"position"} and len(set(labels[here])) == 1:
            kind = types[k].lower()
            which = "measured" if kind in MEASURED else "solved" if kind == SOLVED else None
            if which:
                markers[which].append((labels[k], (k, k + 1, k + 2)))
    known = {name for name, _ in markers["measured"]}
    points = [*markers["measured"], *((name, place) for name, place in markers["solved"] if name not in known)]
    if not points:
        raise DataError(
            f"{source}: has no columns of the type Marker, only {listed(dict.fromkeys(t for t in types[2:] if t))}: "
            "export the take again with `Markers`"
        )
    return Layout(tuple(name for name, _ in points), tuple(place for _, place in points), width, 1)
