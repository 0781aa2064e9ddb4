"""Read the table of a testing machine's file: header, names, units, and the cells of each row.

The table is the longest run of lines that have at least two numbers and the same number of cells. A cell in it may be
missing, or say that there is no number (`---`, `#VALUE!`). What stands before the table is the header. Whatever
separates the columns most consistently is the separator.
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
_NO_NUMBER = re.compile(r"[^0-9a-z]+|#.*|[-+]?inf(inity)?|n[./]?a\.?|null|none|err(or)?|over(load|flow|range)|o\.?l\.?")
"""What programs write, in lower case, where there is no number; more words than these are names or remarks."""
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
        after: the lines after it.
    """

    source: str
    separator: str
    header: tuple[tuple[str, ...], ...]
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    after: tuple[Row, ...] = ()

    def texts(self) -> list[Column]:
        """Return the columns whose cells are words."""
        some = self.rows[:: max(1, len(self.rows) // 50)]
        return [column for column in self.columns if _are_words([row.cells[column.place] for row in some])]

    def words(self, column: Column, rows: Sequence[int]) -> list[int]:
        """Return the rows whose cell in a column of numbers is a word; none of a column of words."""
        cells = [self.rows[k].cells[column.place] for k in rows]
        return [] if _are_words(cells) else [k for k, cell in zip(rows, cells, strict=True) if _is_word(cell)]


def read_table(path: Path) -> Table:
    """Return the table in a text file.

    Raises:
        DataError: the file cannot be read, has no table, or has several.
    """
    source = path.name
    lines = _text(path, source).splitlines()
    separator = max(SEPARATORS, key=lambda sign: _numbers_in_table(lines, sign))
    rows = [Row(number, _cells(line, separator)) for number, line in enumerate(lines, 1) if line.strip(' \t,;"|')]
    _require_one_comma(rows, separator, source)
    first, last = _longest(rows)
    if last - first < 1:
        raise DataError(f"{source}: has no table of numbers: a test has lines with at least two numbers each")
    table = rows[first:last]
    if later := next((row for row in rows[last:] if _count(row.cells) >= FEWEST_NUMBERS), None):
        raise DataError(
            f"{source}:{later.line}: another table begins after line {table[-1].line}: one file is one specimen; write "
            "each table to a file of its own, and give all files together"
        )
    names, units, header = _names(rows[:first], len(table[0].cells))
    columns = tuple(column_of(k, name, unit) for k, (name, unit) in enumerate(zip(names, units, strict=True)))
    return Table(source, separator, header, columns, tuple(table), tuple(rows[last:]))


def _require_one_comma(rows: Sequence[Row], separator: str, source: str) -> None:
    """Raise a DataError if most rows have more cells than there are names: decimal commas separate them, too."""
    start = next((k for k, row in enumerate(rows) if _count(row.cells) >= FEWEST_NUMBERS), 0)
    names = [row.cells for row in rows[:start] if sum(_is_word(cell) for cell in row.cells) >= FEWEST_NUMBERS]
    if separator != "," or not names:
        return
    most = len(names[-1])
    wide = [row for row in rows[start:] if _count(row.cells) == len(row.cells) > most and "." not in "".join(row.cells)]
    if 2 * len(wide) > len(rows) - start:
        raise DataError(
            f"{source}:{wide[0].line}: has {len(wide[0].cells)} cells, but there are {most} names above: decimal "
            "commas cannot be told from commas between columns; write decimals with a point, or semicolons between "
            "columns"
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

    A row whose numbers are missing (NaN) belongs to the run around it, and so does a row with a word for a number
    between two rows without.
    """
    best, start = (0, 0), 0
    while start < len(rows):
        end = start
        if _count(rows[start].cells) >= FEWEST_NUMBERS:
            while end < len(rows) and _continues(rows, start, end):
                end += 1
        if end - start > best[1] - best[0]:
            best = (start, end)
        start = max(end, start + 1)
    first, last = best
    while first > 0 and _is_like(rows[first - 1], rows[first]) and _has_no_words(rows[first - 1].cells):
        first -= 1
    return first, last


def _continues(rows: Sequence[Row], start: int, k: int) -> bool:
    """Return whether a row belongs to the run that starts before it."""
    return _is_like(rows[k], rows[start]) and (_has_place(rows[k].cells) or _is_between(rows, k))


def _is_between(rows: Sequence[Row], k: int) -> bool:
    """Return whether a row has a number, and lies between two rows that have all of theirs."""
    around = [*rows[k - 1 : k], *rows[k + 1 : k + 2]]
    numbers = [row for row in around if _is_like(row, rows[k]) and _has_place(row.cells)]
    return len(numbers) == 2 and _count(rows[k].cells) > 0


def _is_like(row: Row, other: Row) -> bool:
    return len(row.cells) == len(other.cells)


def _has_place(cells: Sequence[str]) -> bool:
    return _count(cells) + _gaps(cells) >= max(FEWEST_NUMBERS, len(cells) - 2)


def _has_no_words(cells: Sequence[str]) -> bool:
    return _count(cells) > 0 and _count(cells) + _gaps(cells) == len(cells)


def _gaps(cells: Sequence[str]) -> int:
    return sum(cell.lower() in MISSING or _NO_NUMBER.fullmatch(cell.lower()) is not None for cell in cells)


def _count(cells: Sequence[str]) -> int:
    return sum(_NUMBER.fullmatch(cell) is not None for cell in cells)


def _is_word(cell: str) -> bool:
    return cell.lower() not in MISSING and _NUMBER.fullmatch(cell) is None


def _are_words(cells: Sequence[str]) -> bool:
    """Return whether more cells are words than numbers; missing ones are neither."""
    return sum(_is_word(cell) for cell in cells) > _count(cells)


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
