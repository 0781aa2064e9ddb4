"""Read the table of a testing machine's file: header, names, units, and the cells of each row.

The table is the longest run of lines that have at least two numbers and the same number of cells. What stands before it
is the header. Whatever separates the columns most consistently is the separator.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cqrun.errors import DataError
from cqrun.plugin.reference import why_unreadable
from cqrun.store.formats.cells import MISSING
from cqrun.store.formats.text import split, stripped
from cqrun.store.formats.unreadable import other_format
from cqrun.tensile.columns import Column, column_of
from cqrun.tensile.units import kinds_of

LARGEST = 100_000_000
"""No file of a test is larger [bytes]."""

SEPARATORS = ("\t", ";", ",", "|", " ")
"""A blank stands for any number of blanks."""

FEWEST_NUMBERS = 2
_NUMBER = re.compile(r"[-+]?(?:[0-9]+(?:[.,][0-9]*)*|[.,][0-9]+)(?:[eE][-+]?[0-9]+)?")


@dataclass(frozen=True)
class Row:
    """A line of the table: its number in the file, from 1, and its cells."""

    line: int
    cells: Sequence[str]


@dataclass(frozen=True)
class Table:
    """A file that was split into cells.

    Attributes:
        source: the file's name in messages.
        separator: what separates columns; a blank for any number of blanks.
        header: cells of the lines before the table, without empty ones.
        columns: what each column is.
        rows: the lines of the table.
    """

    source: str
    separator: str
    header: tuple[tuple[str, ...], ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]

    def texts(self) -> list[Column]:
        """Return the columns whose cells are words."""
        some = self.rows[:: max(1, len(self.rows) // 50)]
        return [
            column for column in self.columns
            if any(_is_word(row.cells[column.place]) for row in some if column.place < len(row.cells))
        ]  # fmt: skip


def read_table(path: Path) -> Table:
    """Return the table in a text file.

    Raises:
        DataError: the file cannot be read, has no table, or has several.
    """
    source = path.name
    lines = _text(path, source).splitlines()
    separator = max(SEPARATORS, key=lambda sign: _numbers_in_table(lines, sign))
    rows = [Row(number, _cells(line, separator)) for number, line in enumerate(lines, 1) if line.strip(' \t,;"|')]
    first, last = _longest(rows)
    if last - first < 1:
        raise DataError(f"{source}: has no table of numbers: a test has lines with at least two numbers each")
    table = rows[first:last]
    if later := next((row for row in rows[last:] if _count(row.cells) >= FEWEST_NUMBERS), None):
        raise DataError(
            f"{source}:{later.line}: another table begins after line {table[-1].line}: one file is one specimen; write "
            "each table to a file of its own, and give all files together"
        )
    _require_one_comma(rows[:first], table, separator, source)
    names, units, header = _names(rows[:first], len(table[0].cells))
    columns = tuple(column_of(k, name, unit) for k, (name, unit) in enumerate(zip(names, units, strict=True)))
    return Table(source, separator, header, columns, tuple(table))


def _require_one_comma(before: Sequence[Row], table: Sequence[Row], separator: str, source: str) -> None:
    """Raise a DataError if rows have more cells than there are names, because decimal commas separate them, too."""
    names = [row.cells for row in before if sum(_is_word(cell) for cell in row.cells) >= FEWEST_NUMBERS]
    cells = len(table[0].cells)
    if separator == "," and names and len(names[-1]) < cells and all(map(str.isdigit, table[0].cells[1::2])):
        raise DataError(
            f"{source}:{table[0].line}: has {cells} cells, but there are {len(names[-1])} names above: decimal commas "
            "cannot be told from commas between columns; write decimals with a point, or semicolons between columns"
        )


def _text(path: Path, source: str) -> str:
    if why := why_unreadable(path):
        raise DataError(f"{path}: cannot be read ({why})")
    with path.open("rb") as file:
        content = file.read(LARGEST + 1)
    if len(content) > LARGEST:
        raise DataError(f"{source}: has more than {LARGEST:,} bytes; is this the table of a test?")
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return content.decode("utf-16", errors="replace")
    if b"\0" in content:
        what = other_format(path) or "not a text file; write the test as CSV from the machine's program"
        raise DataError(f"{source}: {what}")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:  # older programs under Windows; only names and units can have such letters
        return content.decode("cp1252", errors="replace")


def _cells(line: str, separator: str) -> list[str]:
    return stripped(line.split() if separator == " " else split(line, separator))


def _numbers_in_table(lines: Sequence[str], separator: str) -> int:
    """Return how many numbers the longest run of rows has with a separator; a comma cannot be decimal as well."""
    rows = [Row(0, _cells(line, separator)) for line in lines if line.strip()]
    first, last = _longest(rows)
    marks = (",",) if separator == "," else ()
    return sum(_count(row.cells) for row in rows[first:last] if not any(m in c for m in marks for c in row.cells))


def _longest(rows: Sequence[Row]) -> tuple[int, int]:
    """Return the longest run of rows that have numbers in at least two columns, and equally many cells.

    A row whose numbers are missing (NaN) belongs to the run around it.
    """
    best, start = (0, 0), 0
    while start < len(rows):
        end = start
        if _count(rows[start].cells) >= FEWEST_NUMBERS:
            width = len(rows[start].cells)
            while end < len(rows) and len(rows[end].cells) == width and _has_place(rows[end].cells):
                end += 1
        if end - start > best[1] - best[0]:
            best = (start, end)
        start = max(end, start + 1)
    return best


def _has_place(cells: Sequence[str]) -> bool:
    gaps = sum(cell.lower() in MISSING for cell in cells)
    return _count(cells) + gaps >= FEWEST_NUMBERS and _count(cells) + gaps >= len(cells) - 2


def _count(cells: Sequence[str]) -> int:
    return sum(_NUMBER.fullmatch(cell) is not None for cell in cells)


def _is_word(cell: str) -> bool:
    return cell.lower() not in MISSING and _NUMBER.fullmatch(cell) is None


def _names(before: Sequence[Row], width: int) -> tuple[list[str], list[str], tuple[tuple[str, ...], ...]]:
    """Return names and units of the columns, and the header's cells, from the rows before the table."""
    lines, units, names = [row.cells for row in before], [""] * width, [""] * width
    if lines and len(lines) > 1 and _are_units(lines[-1]):
        units = [*lines.pop(), *units][:width]
    if lines and sum(_is_word(cell) for cell in lines[-1]) >= min(FEWEST_NUMBERS, width):
        names = [*lines.pop(), *names][:width]
    return names, units, tuple(tuple(cell for cell in cells if cell) for cells in lines)


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether a row has units alone."""
    words = [cell.strip("()[] ") for cell in cells if cell]
    return bool(words) and all(kinds_of(word) or word in ("°C", "C", "") for word in words)


def facts(table: Table) -> Iterator[tuple[str, str, str]]:
    """Yield (key, value, unit) of the header: `Width (mm);6`, `Width: 6 mm` and `Width = 6;mm`; keys in lower case."""
    for cells in table.header:
        words = list(cells)
        if len(words) == 1 and (match := re.match(r"\s*([^:=]+?)\s*[:=]\s*(.+)", words[0])):
            words = [match[1], match[2]]
        if len(words) < 2:
            continue
        column = column_of(0, words[0].rstrip(":= "))
        value, unit = words[1], column.unit
        if match := re.fullmatch(rf"({_NUMBER.pattern})\s*([^\s0-9.,]\S*)", value):
            value, unit = match[1], match[2]
        elif len(words) > 2 and not unit and kinds_of(words[2]):
            unit = words[2]
        yield column.name.lower(), value, unit
