"""Read the tables (CSV) of runs and studies for a page."""

from __future__ import annotations

import csv
from pathlib import Path

from cqrun.disk import open_file
from cqrun.errors import UsageError
from cqrun.report.words import clipped, short


def table_of(path: Path) -> list[list[str]]:
    """Return the rows of a table, the names of the columns first; all are equally long.

    Raises:
        UsageError: it is missing or damaged.
    """
    try:
        with open_file(path, "r", newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(f"{path}: unreadable ({error}); give the command that made it again, with --fresh") from error
    if not rows or any(len(row) != len(rows[0]) for row in rows):
        raise UsageError(f"{path}: is damaged; give the command that made it again, with --fresh")
    return rows


def cell(text: str) -> str:
    """Return a cell for a page: numbers have four digits, long texts end early."""
    try:
        return text if text.lstrip("-").isdigit() else short(float(text))
    except ValueError:
        return clipped(text)
