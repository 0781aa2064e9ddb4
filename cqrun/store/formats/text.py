"""Lines and cells of recordings that are text, read one line after another, so that a long file needs little memory."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from cqrun.errors import DataError
from cqrun.store.formats.unreadable import other_format

SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas"}
"""What separates the columns of a table, and its name."""

PAGE = "the page Recordings of the documentation (docs/recordings.md) shows every format"
"""Where a reader finds what would be right."""

LONGEST = 4_000_000
"""No line has so many characters; one of 30,000 markers has fewer."""

NEAR = 12
"""So many bytes before and after a wrong one are shown."""

_BEGINNING = 4096
_BLANK = ' \t\r\n,;"'


def beginning(path: Path) -> str:
    """Return the beginning of a file as text, without the blank lines before it; bytes that are no text are replaced.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return file.read(_BEGINNING).decode("utf-8-sig", errors="replace").lstrip()


def lines_of(path: Path, source: str) -> Iterator[tuple[int, str]]:
    """Yield the number of each line, from 1, and the line with its end.

    Raises:
        DataError: the file is not text in UTF-8, or a line is too long.
    """
    number = 0
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            while line := file.readline(LONGEST):
                number += 1
                if len(line) == LONGEST:
                    raise DataError(f"{source}:{number}: a line of {LONGEST:,} characters or more; is this a table?")
                yield number, line
    except UnicodeDecodeError as error:
        near = error.object[max(0, error.start - NEAR) : error.end + NEAR].decode("latin-1")
        what = f"not a text file in UTF-8: byte 0x{error.object[error.start]:02x} in {near!r}; save it as UTF-8"
        raise DataError(f"{source}: {other_format(path) or what}") from error


def header_of(path: Path, source: str) -> tuple[int, str]:
    """Return the first line of a table that is neither blank nor a comment, and its number; raise as `lines_of`."""
    for number, line in lines_of(path, source):
        if not is_blank(line) and not is_comment(line):
            return number, line
    raise DataError(f"{source}: has no header and no data")


def after(path: Path, source: str, header: int) -> Iterator[tuple[int, str]]:
    """Yield the numbers and the lines of a table after its header; raise as `lines_of`."""
    return ((number, line) for number, line in lines_of(path, source) if number > header)


def is_comment(line: str) -> bool:
    """Return whether a line of a table begins with `#`."""
    return line.lstrip()[:1] == "#"


def is_blank(line: str) -> bool:
    """Return whether all cells of a line are empty."""
    return not line.strip(_BLANK)


def split(line: str, separator: str) -> list[str]:
    """Return the cells of a line; a cell in quotes may contain separators."""
    line = line.rstrip("\r\n")
    if '"' not in line:
        return line.split(separator)
    try:
        return next(csv.reader([line], delimiter=separator))
    except csv.Error:  # a cell of more than csv.field_size_limit() characters
        return line.split(separator)


def stripped(cells: Sequence[str]) -> list[str]:
    """Return cells without blanks and quotes around them."""
    return [cell.strip(' \t"') for cell in cells]


def number_in(text: str) -> float | None:
    """Return the finite number that a cell of a header is, whose decimals may follow a comma, or None."""
    if re.fullmatch(r"[-+]?[0-9]{1,30}(?:[.,][0-9]{0,30})?(?:[eE][-+]?[0-9]{1,2})?", text.strip()):
        return float(text.strip().replace(",", "."))
    return None
