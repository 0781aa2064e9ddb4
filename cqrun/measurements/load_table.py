"""Tables of what was measured at rest: one line per load, or per load and marker; CSV with a header.

A unit may stand at the end of a column's name: `x_mm`, `x [mm]`, `force (mN)`.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cqrun.errors import DataError
from cqrun.explain import listed, suggest
from cqrun.plugin.contract import Array

MISSING = ("", "nan")
"""What a cell says if nothing was measured."""

LARGEST = 1e30
"""No measured number is larger."""


@dataclass(frozen=True)
class LoadTable:
    """The cells of a table as text.

    Attributes:
        source: name of the file in error messages.
        head: names of the columns.
        rows: cells of each line.
        lines: number of each line in the file.
    """

    source: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]

    def texts(self, column: str) -> list[str]:
        """Return the cells of a column."""
        k = self.head.index(column)
        return [row[k] for row in self.rows]

    def numbers(self, column: str, *, missing: bool = False) -> Array:
        """Return the numbers of a column (n,); NaN for empty cells, if they are allowed.

        Raises:
            DataError: a cell is not a number, or is empty.
        """
        out = np.full(len(self.rows), np.nan)
        for k, (cell, line) in enumerate(zip(self.texts(column), self.lines, strict=True)):
            if cell.lower() in MISSING:
                if not missing:
                    raise DataError(f"{self.source}:{line}: {column} is empty: every line needs a number")
                continue
            try:
                out[k] = float(cell)
            except ValueError:
                raise DataError(f"{self.source}:{line}: {column} is '{cell[:40]}', which is not a number") from None
            if not abs(out[k]) <= LARGEST:
                raise DataError(f"{self.source}:{line}: {column} is {cell[:40]}, which nobody measures")
        return out

    def require(self, column: str, what: str) -> None:
        """Raise a DataError if there is no column of this name."""
        if column not in self.head:
            near = suggest(column, self.head)
            raise DataError(f"{self.source}: {what} '{column}' is not a column{near}; it has {listed(self.head)}")

    def require_all_used(self, used: Iterable[str], what: str, *, otherwise: str = "") -> None:
        """Raise a DataError for columns that nothing uses; `otherwise` is what else they may be, beside loads."""
        unused = [column for column in self.head if column not in set(used)]
        if unused:
            raise DataError(
                f"{self.source}: the column{'s' * (len(unused) > 1)} {listed(unused)} {what}: if it is a load, name in "
                f"`loads` what it drives, such as {unused[0]}: actuators.NAME.cable.tension; {otherwise}if not, add it "
                "to `ignore`"
            )


def read_table(path: Path) -> LoadTable:
    """Read a table; empty lines and lines that begin with `#` are skipped.

    Raises:
        DataError: it is no table, or has no lines.
    """
    source = str(path)
    if not path.is_file():
        raise DataError(f"{source}: {'not a regular file' if path.exists() else 'there is no such file'}")
    try:
        with path.open(newline="", encoding="utf-8-sig") as text:
            reader = csv.reader(text)
            found = [(tuple(cell.strip() for cell in row), reader.line_num) for row in reader if not _blank(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{source}: not a CSV text file in UTF-8 ({error})") from error
    if len(found) < 2:
        raise DataError(f"{source}: {'has a header but no data' if found else 'the file is empty'}")
    (head, _), *rest = found
    if len(head) == 1 and any(sign in head[0] for sign in ";\t"):
        raise DataError(f"{source}: its columns are not separated by commas: export it with commas and decimal points")
    if repeated := [name for name in dict.fromkeys(head) if head.count(name) > 1 or not name]:
        raise DataError(
            f"{source}: the column '{repeated[0]}' is there {head.count(repeated[0])} times: name each once"
        )
    for row, line in rest:
        if len(row) != len(head):
            raise DataError(f"{source}:{line}: {len(row)} columns instead of {len(head)}; is the file truncated?")
    return LoadTable(source, head, tuple(row for row, _ in rest), tuple(line for _, line in rest))


def _blank(row: Sequence[str]) -> bool:
    return not row or row[0].lstrip().startswith("#") or not any(cell.strip() for cell in row)


def split_unit(column: str, units: Iterable[str]) -> tuple[str, str | None]:
    """Return the name of a column without the unit at its end, and this unit, or None."""
    for unit in units:
        for end in (f"_{unit}", f" [{unit}]", f" ({unit})", f"[{unit}]", f"({unit})"):
            if column.endswith(end) and len(column) > len(end):
                return column[: -len(end)], unit
    return column, None


def factor_of(column: str, units: Mapping[str, float], given: str | None, default: str, source: str) -> float:
    """Return the factor to SI of a column: of the unit in its name, else of the one given, else of the default.

    Raises:
        DataError: its name and the scene give different units.
    """
    _, own = split_unit(column, units)
    if own is not None and given is not None and own != given:
        raise DataError(f"{source}: the column '{column}' is in {own}, and the scene says `units: {given}`: remove one")
    return units[own or given or default]
