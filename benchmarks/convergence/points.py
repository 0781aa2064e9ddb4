"""The points of the convergence tables: what is measured, in which frame, and how finely."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

REFERENCES = Path(__file__).with_name("references.json")

UPDATED = "updated"
"""The name of the updated frame."""


@cache
def references() -> dict[str, Any]:
    """Return what references.json contains."""
    contents: dict[str, Any] = json.loads(REFERENCES.read_text())
    return contents


class NoReference(Exception):
    """references.json lacks the number that a point would be compared with."""


@dataclass(frozen=True, order=True)
class Point:
    """One scene of one test: a row of the table.

    Attributes:
        test: name of the test.
        frame: frame of the scene, or a variant of one: a name in `worlds.FRAMES`.
        dim: 2 or 3.
        law: the elastic law.
        poissons_ratio: its Poisson's ratio.
        case: variant of the test, such as `sticks`; empty if there is one alone.
        cells: cells across the body's height.
        substeps: factor on the substeps that `auto` chooses.
    """

    test: str
    frame: str
    dim: int
    law: str
    poissons_ratio: float
    case: str
    cells: int
    substeps: int

    @property
    def key(self) -> tuple[str, ...]:
        """The texts in the first columns of the row."""
        return tuple(f"{value:g}" if isinstance(value, float) else str(value) for value in asdict(self).values())


KEYS = tuple(field.name for field in fields(Point))
"""Names of the first columns."""

Measured = Mapping[str, float]


@dataclass(frozen=True)
class Test:
    """A test: the variants of its scene, and how one is measured.

    Attributes:
        name: its name.
        summary: one line for the plot.
        columns: what it measures: name of the column -> meaning with unit.
        ideal: values of columns that an exact simulation has.
        variants: (law, nu, case, factor on the substeps), for each number of cells.
        measure: runs the scene of a point and returns its columns.
        decades: columns that are drawn over decades, with zero.
        reference_only: cases that the updated frame does not have.
        hidden: columns that are not drawn.
    """

    __test__ = False  # pytest must not take the class for a test

    name: str
    summary: str
    columns: Mapping[str, str]
    ideal: Mapping[str, float]
    variants: tuple[tuple[str, float, str, int], ...]
    measure: Callable[[Point], Measured]
    decades: tuple[str, ...] = ()
    reference_only: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()

    def points(self, frame: str, dim: int, cells: int) -> Iterator[Point]:
        """Yield the points of a frame, a dimension and a number of cells."""
        for law, nu, case, substeps in self.variants:
            if frame == UPDATED and case in self.reference_only:
                continue
            yield Point(self.name, frame, dim, law, nu, case, cells, substeps)

    def row(self, measured: Measured) -> dict[str, Any]:
        """Return the measured columns, in order.

        Raises:
            KeyError: a column is missing.
        """
        return {name: measured[name] for name in self.columns}
