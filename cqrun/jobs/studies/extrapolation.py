"""Extrapolate a quantity to a cell size of zero, from its values on two or three grids (Richardson).

The error of a value on a grid is taken as a constant times dx^p. From two values, with r the ratio of their cells,

    value = finest + (finest - coarser) / (r^p - 1).

Two grids do not show the order p, so 2 is assumed, the order of the engine for smooth problems. The stated error is the
distance from the finest grid's value to the value of order 1, which covers every order from 1 up. Three grids show p;
the stated error is then 1.25 times the distance from the finest grid's value to the extrapolated one, the grid
convergence index of P. Roache, J. Fluids Eng. 116 (1994). If the values do not converge evenly, the two finest grids
count as alone, and the error is at least the range of all values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import brentq

ASSUMED, LOW = 2.0, 1.0
"""The order that two grids are extrapolated with, and the lower one that gives the error."""

LOWEST, HIGHEST = 0.5, 3.0
"""Range of orders that count as even convergence."""

SAFETY = 1.25
"""Factor of the grid convergence index for three grids."""

How = Literal["equal", "assumed", "observed", "uneven"]
"""`equal` on all grids; the order is `assumed` or `observed`; `uneven`: three grids show no order, so it is assumed."""


@dataclass(frozen=True)
class Extrapolated:
    """A quantity at a cell size of zero: its value, the stated error, the order p, and how the order was found."""

    value: float
    error: float
    order: float
    how: How


def extrapolate(
    cells: Sequence[float], values: Sequence[float], *, log: bool = False, floor: float = 0.0
) -> Extrapolated:
    """Return the value at a cell size of zero.

    Args:
        cells: cell sizes of two or three grids, finest last.
        values: the quantity on each grid.
        log: extrapolate the logarithm; for positive quantities that may change by factors.
        floor: changes up to this size are rounding.
    """
    if log and min(values) > 0:
        inner = extrapolate(cells, [float(np.log(v)) for v in values], floor=floor / min(values))
        value = float(np.exp(inner.value))
        return Extrapolated(value, value * float(np.expm1(inner.error)), inner.order, inner.how)
    spread = max(values) - min(values)
    if spread <= floor:
        return Extrapolated(values[-1], spread, ASSUMED, "equal")
    if len(values) == 3 and (order := observed_order(cells, values)) is not None:
        value = richardson(cells, values, order)
        return Extrapolated(value, SAFETY * abs(value - values[-1]), order, "observed")
    value = richardson(cells, values, ASSUMED)
    error = abs(richardson(cells, values, LOW) - values[-1])
    if len(values) == 2:
        return Extrapolated(value, error, ASSUMED, "assumed")
    return Extrapolated(value, max(error, spread), ASSUMED, "uneven")


def richardson(cells: Sequence[float], values: Sequence[float], order: float) -> float:
    """Return the value at a cell size of zero from the two finest grids, for errors of a given order."""
    return values[-1] + (values[-1] - values[-2]) / ((cells[-2] / cells[-1]) ** order - 1.0)


def observed_order(cells: Sequence[float], values: Sequence[float]) -> float | None:
    """Return the order with which values on three grids converge; None if it is not between 0.5 and 3."""
    coarse, middle, fine = cells
    first, second = values[0] - values[1], values[1] - values[2]

    def excess(order: float) -> float:
        changes = coarse**order - middle**order, middle**order - fine**order
        return float(np.log(first / second) - np.log(changes[0] / changes[1]))

    if second == 0 or first / second <= 0 or excess(LOWEST) * excess(HIGHEST) > 0:
        return None
    return float(brentq(excess, LOWEST, HIGHEST))
