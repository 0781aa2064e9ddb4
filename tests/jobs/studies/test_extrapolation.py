"""Richardson extrapolation of sequences whose limit is known."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.jobs.studies.extrapolation import SAFETY, extrapolate, observed_order

LIMIT, SLOPE = 3.0, 40.0


def sequence(cells, order):
    return [LIMIT + SLOPE * dx**order for dx in cells]


@pytest.mark.parametrize("cells", [(0.01, 0.01 / 1.5), (0.01, 0.005), (0.03, 0.02)])
def test_two_grids_of_order_two_give_the_limit(cells):
    values = sequence(cells, 2)
    found = extrapolate(cells, values)
    assert found.value == pytest.approx(LIMIT, rel=1e-12)
    assert (found.order, found.how) == (2.0, "assumed")
    # the error is |finest - value of order 1|, which is the change between the grids over r - 1
    change = abs(values[1] - values[0])
    assert found.error == pytest.approx(change / (cells[0] / cells[1] - 1), rel=1e-9)


@pytest.mark.parametrize("order", [1.0, 1.3, 2.0, 3.0])
def test_the_error_of_two_grids_covers_the_limit_of_every_order_from_one(order):
    cells = (0.01, 0.01 / 1.5)
    found = extrapolate(cells, sequence(cells, order))
    assert abs(found.value - LIMIT) <= found.error * (1 + 1e-9)


@pytest.mark.parametrize("order", [0.7, 1.0, 1.3, 2.0, 2.8])
@pytest.mark.parametrize("cells", [(0.01, 0.0075, 0.005), (0.04, 0.02, 0.01), (0.01, 0.008, 0.005)])
def test_three_grids_show_their_order(cells, order):
    values = sequence(cells, order)
    found = extrapolate(cells, values)
    assert found.how == "observed"
    assert found.order == pytest.approx(order, rel=1e-6)
    assert found.value == pytest.approx(LIMIT, rel=1e-9)
    assert found.error == pytest.approx(SAFETY * abs(values[-1] - LIMIT), rel=1e-6)


@pytest.mark.parametrize(
    "values",
    [
        (1.0, 1.2, 1.1),  # to and fro
        (1.0, 1.1, 1.3),  # away from each other
        (1.0, 1.0, 1.1),
        (1.0, 1.1, 1.1 + 1e-6),  # far faster than any order of the engine
    ],
)
def test_values_that_do_not_converge_evenly(values):
    cells = (0.04, 0.02, 0.01)
    assert observed_order(cells, values) is None
    found = extrapolate(cells, values)
    assert found.how == "uneven"
    assert found.value == pytest.approx(values[2] + (values[2] - values[1]) / 3)
    assert found.error == pytest.approx(max(abs(values[2] - values[1]), max(values) - min(values)))


def test_changes_of_rounding_are_none():
    found = extrapolate((0.02, 0.01), (23.5, 23.5 + 1e-9), floor=1e-6)
    assert (found.value, found.how) == (23.5 + 1e-9, "equal")
    assert found.error == pytest.approx(1e-9, rel=1e-3)
    assert extrapolate((0.03, 0.02, 0.01), (1.0, 1.0, 1.0)).error == 0.0


def test_logarithms_keep_a_quantity_positive():
    """A viscosity that falls by half: order 2 of the numbers themselves would be negative beyond a factor of 2.25."""
    cells, values = (0.01, 0.01 / 1.5), (100.0, 40.0)
    assert extrapolate(cells, values).value < 0
    found = extrapolate(cells, values, log=True)
    assert found.value == pytest.approx(40.0 * (40.0 / 100.0) ** 0.8)
    assert found.error == pytest.approx(found.value * ((100.0 / 40.0) ** 2 - 1))
    exact = [float(np.exp(LIMIT + SLOPE * dx**2)) for dx in cells]
    assert extrapolate(cells, exact, log=True).value == pytest.approx(np.exp(LIMIT))
