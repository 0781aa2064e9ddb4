"""Recognise files of other programs that hold recordings in a form that cqrun does not read, and say what to do."""

from __future__ import annotations

import re
from pathlib import Path

LONG = "write one line for each marker and frame: time,marker,x,y,z"
_BEGINNING = 4096
_BY_BEGINNING = (
    (b"PK\x03\x04", "a spreadsheet or another packed file", "save its table as CSV text"),
    (b"\xd0\xcf\x11\xe0", "a spreadsheet of Excel", "save its table as CSV text"),
    (b"\x89HDF", "an HDF5 file", "if it is a trajectory.h5 of cqrun, let its name end in .h5"),
    (b"\xff\xfe", "text in UTF-16", "save it as UTF-8"),
    (b"\xfe\xff", "text in UTF-16", "save it as UTF-8"),
)
_BY_TEXT = (
    (r"Format Version\s*,", "a CSV file of OptiTrack Motive", f"export the take as C3D in Motive, or {LONG}"),
    (
        r"(Trajectories|Devices|Model Outputs|Joints|Segments)[\s,]",
        "a CSV file of Vicon",
        f"export the trial as C3D in Vicon, or {LONG}",
    ),
    (
        r"NO_OF_FRAMES\s",
        "a TSV file of Qualisys",
        f"export the measurement as C3D in Qualisys Track Manager, or {LONG}",
    ),
    (
        r"PathFileType\s",
        "a TRC file (OpenSim, Cortex)",
        f"export the recording as C3D in the program that recorded it, or {LONG}",
    ),
    (r"scorer\s*,", "a CSV file of DeepLabCut", f"turn pixels into lengths, and {LONG}"),
)
_COORDINATE = re.compile(r"(.+?)[\s_.:\-\[(]*[xyz][\])]?", re.IGNORECASE)


def other_format(path: Path) -> str:
    """Return what a file is and what to do with it, as the rest of a sentence; nothing if it is not known.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(_BEGINNING)
    if len(data) > 1 and data[1] == 0x50 and data[0] in range(2, 32):
        return "is a C3D file: let its name end in .c3d"
    for beginning, what, advice in _BY_BEGINNING:
        if data.startswith(beginning):
            return f"is {what}: {advice}"
    text = data.decode("utf-8-sig", errors="replace").lstrip()
    for pattern, what, advice in _BY_TEXT:
        if re.match(pattern, text):
            return f"is {what}, which cqrun does not read: {advice}"
    return _table(text.splitlines()[0] if text else "")


def _table(header: str) -> str:
    """Return what is unusual in the first line of a table, or nothing."""
    for separator, name in (("\t", "tabs"), (";", "semicolons")):
        if header.count(separator) >= 2:
            return f"has columns that are separated by {name}: write commas, and points in numbers"
    columns = [column.strip(' "') for column in header.split(",")]
    of = [match[1].casefold() for column in columns if (match := _COORDINATE.fullmatch(column))]
    if len(of) >= 2 and len(set(of)) < len(of):
        return f"has a column for each coordinate of each marker, which cqrun does not read: {LONG}"
    return ""
