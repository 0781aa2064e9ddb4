"""Write history.csv: one row per iteration; it can be read during the run."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from cqrun.errors import UsageError
from cqrun.store.atomic import append_durably, disk_errors, write_text

ITERATION, SECONDS = "iteration", "seconds"


class History:
    """The rows of a run, numbered from 0 without gaps.

    If a row is recorded again with the same numbers, the old row is kept with its seconds, so that a resumed optimizer
    can repeat its steps. A row with other numbers replaces the old one and drops all rows after it.

    Args:
        path: the file; if it does not exist, it is made with its header, otherwise an incomplete last row is dropped.
        columns: names of the columns between `iteration` and `seconds`; they never change during a run.

    Raises:
        UsageError: the file has other columns.
    """

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self.path = path
        self.columns = (ITERATION, *columns, SECONDS)
        header = ",".join(_quoted(name) for name in self.columns) + "\n"
        if not path.exists():
            write_text(path, header)
        with disk_errors(path):
            self._file = path.open("r+b", buffering=0)
        content = self._file.read()
        if not content.startswith(header.encode()):
            self._file.close()
            raise UsageError(f"{path}: its columns are not those of this run; start the run over with --fresh")
        self._rows: list[bytes] = []
        self._ends = [len(header.encode())]
        self._take_whole_rows(content[self._ends[0] :])
        self.truncate(len(self._rows))

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def seconds(self) -> float:
        """The seconds of the last row; 0 if there are no rows."""
        return float(self._rows[-1].rsplit(b",", 1)[1]) if self._rows else 0.0

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
        if iteration < len(self) and self._rows[iteration].rsplit(b",", 1)[0] == start:
            return
        self.truncate(iteration)
        with disk_errors(self.path):
            self._append(start + f",{seconds:.3f}\n".encode())

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

    def _append(self, row: bytes) -> None:
        self._file.seek(self._ends[-1])
        append_durably(self._file, row)
        self._keep(row)

    def _keep(self, row: bytes) -> None:
        self._rows.append(row.rstrip(b"\n"))
        self._ends.append(self._ends[-1] + len(row))

    def _take_whole_rows(self, content: bytes) -> None:
        for row in content.splitlines(keepends=True):
            fields = row.split(b",")
            whole = row.endswith(b"\n") and len(fields) == len(self.columns)
            if not whole or fields[0] != str(len(self)).encode():
                return
            self._keep(row)


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if any(c in name for c in ',"\n') else name


def read_history(path: Path) -> dict[str, list[float]]:
    """Return the columns of a history, also during a run; an incomplete last row is skipped."""
    import csv

    with disk_errors(path):
        lines = path.read_text().splitlines(keepends=True)
    rows = list(csv.reader(line for line in lines if line.endswith("\n")))
    whole = [row for row in rows[1:] if len(row) == len(rows[0])]
    return {name: [float(row[i]) for row in whole] for i, name in enumerate(rows[0])}
