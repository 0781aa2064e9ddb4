"""Recognise files that cqrun does not read as recordings, and say what to do."""

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
_DEEPLABCUT = re.compile(r"scorer\s*[,;\t]")


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
    if _DEEPLABCUT.match(data.decode("utf-8-sig", errors="replace").lstrip()):
        return f"is a CSV file of DeepLabCut, which cqrun does not read: turn pixels into lengths, and {LONG}"
    return ""
