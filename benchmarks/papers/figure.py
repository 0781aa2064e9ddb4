"""What a figure is: the work behind it, a table of numbers, a picture of the table, and a verdict on it.

The table is all that the verdict knows, so that it can be checked on the CSV that is committed.
"""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from benchmarks.papers.machinery.work import Found, Work
from cqrun.store import atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Picture

OWN = "cqrun's own"
"""The source of what is in neither paper."""

Column = np.ndarray
Table = dict[str, Column]
"""Columns of one length by name; numbers (NaN where there is none) or words."""


class Size(StrEnum):
    """How much work a figure is."""

    QUICK = "quick"
    PAPER = "paper"


class Judgement(StrEnum):
    """What a verdict comes to; EXCEEDED is more than the paper's, by more than the spread of its runs, or than a
    tenth where it gives none."""

    MET = "reproduced"
    EXCEEDED = "exceeded"
    PARTLY = "in part"
    MISSED = "not reproduced"
    UNFINISHED = "unfinished"


@dataclass(frozen=True)
class Verdict:
    """A judgement, and the checks behind it: what each says, with its numbers, and whether it holds."""

    judgement: Judgement
    checks: Mapping[str, bool]

    def __str__(self) -> str:
        told = "; ".join(f"{said} ({'yes' if holds else 'NO'})" for said, holds in self.checks.items())
        return f"{self.judgement}: {told}"


def judged(checks: Mapping[str, bool]) -> Verdict:
    """Return the verdict on checks: all, some, or none of them hold; no checks hold nothing."""
    checks = {said: bool(holds) for said, holds in checks.items()}
    good = sum(checks.values())
    judgement = Judgement.MISSED if not good else Judgement.MET if good == len(checks) else Judgement.PARTLY
    return Verdict(judgement, checks)


def lowered(verdict: Verdict, checks: Mapping[str, bool]) -> Verdict:
    """Return a verdict with checks that can only make it worse: where one fails, it is met in part at best."""
    fails = verdict.judgement is not Judgement.MISSED and not all(checks.values())
    return Verdict(Judgement.PARTLY if fails else verdict.judgement, {**verdict.checks, **checks})


class Figure(ABC):
    """A figure or table of a paper.

    Attributes:
        id: names its files.
        title: what it shows.
        source: where in the papers.
        paper: what is printed there, in words and numbers.
        tolerance: what is asked at each size for the verdict, declared before a run; of what was settled after runs
            had been seen `left_open` tells.
        left_open: what the paper does not say and we chose, or why a number is not met; may be empty.
        needs_runs: its picture cannot be drawn from the table alone.
    """

    id: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    paper: ClassVar[str]
    tolerance: ClassVar[dict[Size, str]]
    left_open: ClassVar[str] = ""
    needs_runs: ClassVar[bool] = False

    @abstractmethod
    def work(self, size: Size) -> Sequence[Work]:
        """Return what has to be done for it."""

    @abstractmethod
    def table(self, found: Found, size: Size) -> Table:
        """Return its numbers, from the folders of its work; of what is unfinished, what there is."""

    @abstractmethod
    def draw(self, table: Table, size: Size, found: Found) -> Picture:
        """Return the picture of the table, with the paper's values as marks or bands; `found` is for bodies."""

    @abstractmethod
    def judge(self, table: Table, size: Size) -> Verdict:
        """Return the verdict."""


def write_table(table: Table, path: Path) -> None:
    """Write a table as CSV, numbers to seven digits."""
    rows = ([_cell(value) for value in row] for row in zip(*table.values(), strict=True))
    atomic.write_table(path, [list(table), *rows])


def _cell(value: object) -> str:
    if isinstance(value, str):
        return value
    number = float(value)  # type: ignore[arg-type]
    return "" if np.isnan(number) else f"{number:.7g}"


def read_table(path: Path) -> Table:
    """Return a table from its CSV."""
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    return {name: _column(cells) for name, cells in zip(rows[0], zip(*rows[1:], strict=True), strict=True)}


def _column(cells: Sequence[str]) -> Column:
    try:
        return np.array([float(cell) if cell else np.nan for cell in cells])
    except ValueError:
        return np.array(cells)


def stacked(parts: Iterator[Mapping[str, object]]) -> Table:
    """Return a table of rows, each a mapping from columns to cells; what a row lacks is NaN."""
    rows = list(parts)
    names = list(dict.fromkeys(name for row in rows for name in row))
    return {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}
