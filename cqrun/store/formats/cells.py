"""Numbers in the cells of a table: gaps, decimal points, and decimal commas where they can mean nothing else.

Columns that are separated by semicolons or tabs may have decimal commas. 1,234 could also be one thousand two hundred
and thirty-four. So another number of the file must show that commas are decimal: 0,5 or 12,25 do.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from operator import itemgetter

from cqrun.errors import DataError
from cqrun.explain import cut

NAN = float("nan")
MISSING = ("", "nan")
"""What a cell says if a marker was not seen."""

_POINT, _COMMA = "point", "comma"
_DOUBTFUL = re.compile(r"[-+]?[1-9][0-9]{0,2},[0-9]{3}")


class Numbers:
    """Turn the cells of some columns into numbers.

    Args:
        places: the columns, from 0.
        labels: what each of them is, in messages.
        separator: what separates columns.
        source: name of the recording in messages.
    """

    def __init__(self, places: Sequence[int], labels: Sequence[str], separator: str, source: str) -> None:
        self._places, self._labels, self._source = places, labels, source
        self._pick = itemgetter(*places) if len(places) > 1 else lambda cells: (cells[places[0]],)
        self._mark = _POINT if separator == "," else ""
        self._first = ""  # the first number with decimals, and its line
        self._doubt = ""  # where the first number with a comma is, until another one shows that commas are decimal

    def row(self, cells: Sequence[str], line: int) -> list[float]:
        """Return the numbers of a line; NaN for cells that are empty or `nan`.

        Raises:
            DataError: a cell is no number, or its decimals follow another sign than those of other cells.
        """
        picked = self._pick(cells)
        try:  # the usual cases, fast
            if self._mark == _POINT:
                return [float(cell) if cell else NAN for cell in picked]
            if self._mark == _COMMA and not self._doubt:
                text = "\n".join(picked)
                if "." not in text:
                    return [float(cell) if cell else NAN for cell in text.replace(",", ".").split("\n")]
        except ValueError:
            pass
        return [self._number(k, cells, line) for k in range(len(self._places))]

    def finish(self) -> None:
        """Raise a DataError if nothing has shown what the commas mean."""
        if self._doubt:
            raise DataError(
                f"{self._doubt} may have a decimal comma or a comma between thousands, and no other number of the file "
                "decides it: write decimal points"
            )

    def at(self, k: int, cells: Sequence[str], line: int) -> str:
        """Return where the k-th number is: file, line and column of the line."""
        return f"{self._source}:{line}:{1 + sum(len(cell) + 1 for cell in cells[: self._places[k]])}"

    def _number(self, k: int, cells: Sequence[str], line: int) -> float:
        cell = cells[self._places[k]].strip()
        if cell.lower() in MISSING:
            return NAN
        is_what = f"{self.at(k, cells, line)}: {self._labels[k]} is '{cut(cell)}'"
        if self._mark != _POINT or self._first:
            cell = self._with_point(cell, is_what, line)
        try:
            return float(cell)
        except ValueError:
            advice = ": write decimal points" if "," in cell else ""
            raise DataError(f"{is_what}, which is not a number{advice}") from None

    def _with_point(self, cell: str, is_what: str, line: int) -> str:
        """Return a cell with a decimal point; the columns are not separated by commas."""
        if "," in cell and "." in cell:
            raise DataError(
                f"{is_what}, with a comma and a point: write no signs between thousands, and one for decimals"
            )
        mark = _COMMA if "," in cell else _POINT if "." in cell else ""
        if mark and self._mark and mark != self._mark:
            raise DataError(
                f"{is_what}, with a decimal {mark}, but the decimals of {self._first} follow a {self._mark}: write "
                "points in all numbers"
            )
        if mark and not self._mark:
            self._mark, self._first = mark, f"{cut(cell)} in line {line}"
            self._doubt = is_what if mark == _COMMA else ""
        if mark == _COMMA and not _DOUBTFUL.fullmatch(cell):
            self._doubt = ""
        return cell.replace(",", ".")
