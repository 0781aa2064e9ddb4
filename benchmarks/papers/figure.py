"""What a figure is: the tasks behind it, a table of numbers, a picture of the table, and a verdict on it.

The verdict reads nothing but the table. So anyone can check it on the CSV that is committed.
"""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.machinery.task import Task
from cqrun.store import atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

NOT_PRINTED = "cqrun's own"
"""The source of a figure that is in neither paper."""

Column = np.ndarray
Table = dict[str, Column]
"""Columns of equal length by name; numbers (NaN where there is none) or words."""

Folders = Mapping[str, Path]
"""The folders of tasks that have begun, by the task's name."""


class Size(StrEnum):
    """How much work a figure takes: some minutes, or as much as in the papers."""

    QUICK = "quick"
    PAPER = "paper"


class Judgement(StrEnum):
    """The outcome of a verdict.

    EXCEEDED means better than the paper's, by more than the spread of its runs, or by more than a tenth where the
    paper gives no spread.
    """

    MET = "reproduced"
    EXCEEDED = "exceeded"
    PARTLY = "in part"
    MISSED = "not reproduced"
    UNFINISHED = "unfinished"


MET, PARTLY, MISSED = Judgement.MET, Judgement.PARTLY, Judgement.MISSED


@dataclass(frozen=True)
class Verdict:
    """A judgement, and the checks behind it: each says what was found, and whether that is enough."""

    judgement: Judgement
    checks: Mapping[str, bool]

    @classmethod
    def of(cls, checks: Mapping[str, bool]) -> Verdict:
        """Return the verdict on checks: all hold, some do, or none does. Without checks, nothing is reproduced."""
        checks = {text: bool(holds) for text, holds in checks.items()}
        count = sum(checks.values())
        return cls(MISSED if not count else MET if count == len(checks) else PARTLY, checks)

    def also(self, conditions: Mapping[str, bool]) -> Verdict:
        """Return the verdict with further checks that can only lower it: if one fails, it is "in part" at best."""
        lowered = self.judgement is not MISSED and not all(conditions.values())
        return Verdict(PARTLY if lowered else self.judgement, {**self.checks, **conditions})

    def __str__(self) -> str:
        checks = "; ".join(f"{text} ({'yes' if holds else 'NO'})" for text, holds in self.checks.items())
        return f"{self.judgement}: {checks}"


class Figure(ABC):
    """A figure or table of a paper."""

    id: ClassVar[str]  # names its files
    title: ClassVar[str]
    source: ClassVar[str]  # where it is in the papers
    paper: ClassVar[str]  # what the paper prints, in words and numbers
    criteria: ClassVar[dict[Size, str]]  # what the verdict asks for, written before the runs except as the notes say
    notes: ClassVar[str] = ""  # what the paper does not say and we chose, and why numbers are missed
    needs_runs: ClassVar[bool] = False  # its picture shows more than the table, such as moving bodies

    @abstractmethod
    def tasks(self, size: Size) -> Sequence[Task]:
        """Return the tasks that have to be done for it."""

    @abstractmethod
    def table(self, folders: Folders, size: Size) -> Table:
        """Return its numbers from the folders of its tasks; of unfinished tasks, as many as there are."""

    @abstractmethod
    def draw(self, table: Table, size: Size, folders: Folders) -> Picture:
        """Return the picture of the table, with the paper's values as marks or bands."""

    @abstractmethod
    def judge(self, table: Table, size: Size) -> Verdict:
        """Return the verdict."""

    def command(self, size: Size) -> str:
        """Return the command that makes the figure."""
        return f"python -m benchmarks.papers --size {size} --only {self.id}"


def table_of(rows: Iterable[Mapping[str, object]]) -> Table:
    """Return the table of rows, each a mapping from columns to cells; a missing cell is NaN."""
    rows = list(rows)
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}


def write_table(table: Table, path: Path) -> None:
    """Write a table as CSV, with seven digits for each number."""
    rows = ([_cell(value) for value in row] for row in zip(*table.values(), strict=True))
    atomic.write_table(path, [list(table), *rows])


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    number = float(value)  # type: ignore[arg-type]
    return "" if np.isnan(number) else f"{number:.7g}"


def read_table(path: Path) -> Table:
    """Return the table in a CSV."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    return {name: _column(cells) for name, cells in zip(rows[0], zip(*rows[1:], strict=True), strict=True)}


def _column(cells: Sequence[str]) -> Column:
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells)
