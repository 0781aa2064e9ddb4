"""The table of measured points, a CSV file: one row per point, written after each, so a stopped command continues."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from benchmarks.convergence.points import KEYS, Point, Test
from cqrun.store.atomic import write_table

LAST = ("seconds", "engine", "note")
"""Columns after the measured ones: wall time [s], hash of the engine, and why a point has no numbers."""


class Table:
    """The rows of the file, by point; columns and order follow the tests.

    Args:
        path: the file; it need not exist.
        tests: all tests, which give the columns.

    Raises:
        ValueError: the file has other key columns.
    """

    def __init__(self, path: Path, tests: Sequence[Test]) -> None:
        self.path, self._tests = path, tests
        self.columns = (*KEYS, *dict.fromkeys(name for test in tests for name in test.columns), *LAST)
        self.rows: dict[tuple[str, ...], dict[str, str]] = {}
        if path.exists():
            with path.open(newline="", encoding="utf-8") as file:
                reader = csv.DictReader(file)
                if tuple(reader.fieldnames or ())[: len(KEYS)] != KEYS:
                    raise ValueError(f"{path}: the first columns must be {', '.join(KEYS)}; move the file away")
                self.rows = {tuple(row[key] for key in KEYS): row for row in reader}

    def has(self, point: Point, engine: str | None = None) -> bool:
        """Return whether a point has a row, made by an engine if one is given."""
        row = self.rows.get(point.key)
        return row is not None and engine in (None, row["engine"])

    def add(self, point: Point, values: Mapping[str, float], seconds: float, engine: str, note: str = "") -> None:
        """Add the row of a point, and write the file."""
        texts = {name: "" if math.isnan(value) else f"{value:.6g}" for name, value in values.items()}
        keys = dict(zip(KEYS, point.key, strict=True))
        self.rows[point.key] = {**keys, **texts, "seconds": f"{seconds:.1f}", "engine": engine, "note": note}
        write_table(self.path, self._lines())

    def _lines(self) -> Iterable[Iterable[str]]:
        yield self.columns
        for key in sorted(self.rows, key=self._place):
            yield [self.rows[key].get(column) or "" for column in self.columns]

    def _place(self, key: tuple[str, ...]) -> tuple[object, ...]:
        """Return what rows are sorted by: test, dimension, law, nu, case, frame, cells, substeps."""
        names, row = [test.name for test in self._tests], dict(zip(KEYS, key, strict=True))
        test = names.index(row["test"]) if row["test"] in names else len(names)
        nu, cells, substeps = float(row["poissons_ratio"]), int(row["cells"]), int(row["substeps"])
        return test, row["test"], row["dim"], row["law"], nu, row["case"], row["frame"], substeps, cells
