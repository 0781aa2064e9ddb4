"""Write history.csv: one row per iteration; it can be read during the run.

The last column, `crc32`, guards its row: it is the CRC-32 of all that stands before its comma. Runs of earlier versions
do not have it.
"""

from __future__ import annotations

import csv
import os
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from cqrun.disk import open_file
from cqrun.errors import UsageError
from cqrun.store.atomic import append_durably, disk_errors, write_text

ITERATION, SECONDS, CHECK = "iteration", "seconds", "crc32"


class History:
    """The rows of a run, numbered from 0 without gaps.

    If a row is recorded again with the same numbers, the old row is kept with its seconds, so that a resumed optimizer
    can repeat its steps. A row with other numbers replaces the old one and drops all rows after it.

    Args:
        path: the file; if it does not exist, it is made with its header, otherwise an incomplete last row is dropped.
        columns: names of the columns between `iteration` and `seconds`; they never change during a run.

    Raises:
        UsageError: the file has other columns, or a damaged row.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path = path
        self.columns = (ITERATION, *columns, SECONDS)
        header, unguarded = (_header(names) for names in ((*self.columns, CHECK), self.columns))
        if not path.exists():
            write_text(path, header.decode())
        with disk_errors(path):
            self._file = open_file(path, "r+b", buffering=0)
            content = self._file.read()
        try:
            self._guarded = content.startswith(header)
            if not self._guarded and not content.startswith(unguarded):
                raise UsageError(
                    f"{path}: its columns are not those of this run, or it is damaged; start the run over with --fresh"
                )
            self._rows = list(_whole_rows(path, content, len(self.columns) + self._guarded))
        except UsageError:
            self._file.close()
            raise
        self._ends = [len(header if self._guarded else unguarded)]
        for row in self._rows:
            self._ends.append(self._ends[-1] + len(row) + 1)
        self.truncate(len(self._rows))

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def seconds(self) -> float:
        """The seconds of the last row; 0 if there are no rows."""
        return float(self._numbers(self._rows[-1]).rsplit(b",", 1)[1]) if self._rows else 0.0

    def record(self, iteration: int, values: Mapping[str, float], seconds: float) -> None:
        """Record a row.

        Args:
            iteration: at most the number of rows so far.
            values: a number for each column.
            seconds: time since the run began, including earlier processes [s].

        Raises:
            ValueError: an iteration was skipped, or a column is missing.
            UsageError, RunError: the row cannot be written.
        """
        if iteration > len(self):
            raise ValueError(f"iteration {iteration} after {len(self) - 1}: one was skipped")
        numbers = [float(values[name]) for name in self.columns[1:-1]]
        start = ",".join([str(iteration), *(repr(number) for number in numbers)]).encode()
        if iteration < len(self) and self._numbers(self._rows[iteration]).rsplit(b",", 1)[0] == start:
            return
        self.truncate(iteration)
        row = start + f",{seconds:.3f}".encode()
        with disk_errors(self.path):
            self._append(row + b",%d" % zlib.crc32(row) if self._guarded else row)

    def truncate(self, rows: int) -> None:
        """Drop every row from number `rows` on, and any incomplete row after them."""
        del self._rows[rows:]
        del self._ends[rows + 1 :]
        with disk_errors(self.path):
            self._file.truncate(self._ends[-1])
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _numbers(self, row: bytes) -> bytes:
        """Return a row without its checksum."""
        return row.rsplit(b",", 1)[0] if self._guarded else row

    def _append(self, row: bytes) -> None:
        self._file.seek(self._ends[-1])
        append_durably(self._file, row + b"\n")
        self._rows.append(row)
        self._ends.append(self._ends[-1] + len(row) + 1)


def _header(names: Sequence[str]) -> bytes:
    return (",".join(_quoted(name) for name in names) + "\n").encode()


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if any(c in name for c in ',"\n') else name


def _whole_rows(path: Path, content: bytes, fields: int) -> Iterator[bytes]:
    """Yield the rows of a history, without the last one if it is incomplete.

    Args:
        content: of the file.
        fields: number of columns, with the checksum if the file has one.

    Raises:
        UsageError: another row is damaged.
    """
    header, *rows = content.split(b"\n")
    guarded = header.endswith(f",{CHECK}".encode())
    if rows and not rows[-1]:
        rows.pop()  # what follows the last line feed
        complete = len(rows)
    else:
        complete = len(rows) - 1
    for number, row in enumerate(rows):
        if number < complete and _is_whole(row, number, fields, guarded):
            yield row
        elif number < len(rows) - 1:
            raise UsageError(
                f"{path}:{number + 2}: this row is damaged, and others follow it; start the run over with --fresh"
            )


def _is_whole(row: bytes, number: int, fields: int, guarded: bool) -> bool:
    cells = row.split(b",")
    if len(cells) != fields or cells[0] != b"%d" % number:
        return False
    if guarded:
        return cells[-1] == b"%d" % zlib.crc32(row.rsplit(b",", 1)[0])
    return all(map(_is_number, cells))


def _is_number(cell: bytes) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_history(path: Path) -> dict[str, list[float]]:
    """Return the columns of a history, also during a run; an incomplete last row is skipped.

    Raises:
        UsageError: it is damaged.
    """
    with disk_errors(path), open_file(path) as file:
        content = file.read()
    names = next(csv.reader([content.split(b"\n", 1)[0].decode(errors="replace")]), [])
    if ITERATION not in names or SECONDS not in names:
        raise UsageError(f"{path}: its first line is damaged; start the run over with --fresh")
    rows = [row.split(b",") for row in _whole_rows(path, content, len(names))]
    return {name: [float(row[i]) for row in rows] for i, name in enumerate(names) if name != CHECK}
