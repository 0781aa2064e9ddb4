"""An adjoint against differences along one direction: what a scan of steps shows of a derivative."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.design.params import Params
from cqrun.running.finite_differences import ALL_STEPS, AT_A_KINK, STEPS, TOO_ROUGH, central, check_direction, plateau
from cqrun.running.state_loss import Loss


def test_extrapolation_is_of_fourth_order_and_its_plateau_is_found_blind():
    scan = central(np.exp(0.3 + STEPS), np.exp(0.3 - STEPS))
    errors = np.abs(scan / np.exp(0.3) - 1)
    assert errors[0] < 1e-10  # h = 0.01: fourth order; second order leaves 2e-5
    assert errors[plateau(scan)] < 1e-11


def test_a_plateau_is_found_beside_rollouts_that_failed():
    scan = np.array([np.nan, np.nan, 3.0, 2.0, 2.001, 2.0005, 2.5, 1.0])
    assert plateau(scan) == 4
    assert plateau(np.full(5, np.nan)) == 4


def checked(value, x, adjoint):
    """Return what differences of a function of one number at x say of a derivative."""
    loss = Loss("f", Params(()), np.array([x]), lambda x: float(value(x[0])), lambda x: (0.0, np.zeros(1)), 1.0)
    return check_direction("x", loss, float(value(x)), np.array([adjoint]), np.ones(1), "float64")


@pytest.mark.parametrize("adjoint", [0.0, 1.0])
def test_a_direction_whose_rollouts_all_fail_disagrees_after_the_usual_steps(adjoint):
    row = checked(lambda x: np.nan, 0.0, adjoint)
    assert (row.verdict, row.agrees, row.differences) == ("disagrees", False, None)
    assert len(row.scan) == len(STEPS) - 1


@pytest.mark.parametrize("slope", [1e4, 1e6, 1e8])
def test_a_loss_that_saturates_at_large_steps(slope):
    """There E is its range by the step, and so least where the step is largest."""

    def value(x):
        return np.tanh(slope * (x - 0.4)) + 1.0

    right, wrong = checked(value, 0.4, slope), checked(value, 0.4, 1.001 * slope)
    assert (right.verdict, wrong.verdict) == ("agrees", "disagrees")
    assert right.differences == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("size", [5e-5, 0.3, -0.9])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_kink_at_any_distance(size, side):
    """As stick and slip make them: a right derivative is told right however near the kink is, a wrong one wrong."""
    for distance in (0.0, *10.0 ** np.arange(-15.0, 0.0)):

        def value(x, distance=distance):
            return 0.3 + x + 0.4 * x**2 + size * max(side * x - distance, 0.0)

        assert checked(value, 0.0, 1.0).agrees, distance
        for wrong in (1.001, 0.83):
            assert not checked(value, 0.0, wrong).agrees, (distance, wrong)


def test_a_plateau_beyond_a_kink_is_not_the_derivative():
    """Between 1e-3 and 1e-6 differences are of one size, but the smallest steps contradict them."""

    def value(x):
        return 0.3 + x + 0.5 * max(x - 1e-7, 0.0)

    row = checked(value, 0.0, 1.0)
    assert row.verdict == "agrees"
    assert row.step < 4e-7
    assert checked(value, 0.0, 1.25).verdict == "disagrees"


def test_either_slope_of_a_kink_is_a_derivative():
    for adjoint in (-1.0, 1.0):
        row = checked(lambda x: abs(x) + x**2, 0.0, adjoint)
        assert (row.verdict, row.agrees) == (AT_A_KINK, True)
        assert row.differences == pytest.approx(adjoint, rel=1e-9)
    for adjoint in (-0.5, 0.5, 1.001):
        assert checked(lambda x: abs(x) + x**2, 0.0, adjoint).verdict == "disagrees"


def test_many_kinks_on_both_sides(rng):
    """No wrong derivative is told right, no right one wrong, and few are too rough to tell."""
    right = []
    for _ in range(60):
        places = rng.choice([-1.0, 1.0], 6) * 10 ** rng.uniform(-10, -2, 6)
        sizes = rng.normal(size=6) * 10 ** rng.uniform(-5, 0, 6)

        def value(x, places=places, sizes=sizes):
            return 0.3 + x + 0.4 * x**2 + sizes @ np.maximum(np.sign(places) * (x - places), 0.0)

        right.append(checked(value, 0.0, 1.0).verdict)
        assert not checked(value, 0.0, 1.001).agrees
    assert right.count("disagrees") == 0
    assert right.count(TOO_ROUGH) <= 6


def test_a_loss_with_steps_of_all_sizes():
    """As contacts, sticks and slips make them, on a slope of 1."""

    def value(x):
        return x + sum(2.0**-k * (np.floor(x * 3.7 * 2.0**k + 0.37 * k) % 2) for k in range(1, 50))

    for adjoint in (1.0, -3.0, 20.0):
        assert not checked(value, 0.4137, adjoint).agrees
    assert checked(value, 0.4137, 1.0).verdict == TOO_ROUGH


@pytest.mark.parametrize(("off", "agrees"), [(0.0, True), (1.5e-5, True), (1e-3, False)])
def test_a_gradient_within_the_scatter_of_its_differences(off, agrees):
    """Differences that scatter by 2e-5 cannot tell an error of that size, but one of a thousandth."""
    # f(x) = x, with an error of its differences at every step that does not fall with it
    error = 2e-5 * (-1.0) ** np.arange(len(ALL_STEPS))
    at = {round(float(np.log(h)), 6): e for h, e in zip(ALL_STEPS, error, strict=True)}

    def value(x: np.ndarray) -> float:
        h = float(x[0])
        return h * (1.0 + at[round(float(np.log(abs(h))), 6)])

    loss = Loss("x", Params(()), np.zeros(1), value, lambda x: (0.0, np.ones(1)), 0.0)
    row = check_direction("x", loss, 0.0, np.array([1.0 + off]), np.ones(1), "float64")
    assert row.noise > 1e-5
    assert bool(row.agrees) is agrees


def test_a_scan_that_is_rounding_alone_is_flat(rng):
    """Larger rounding than the loss lets expect: differences tell nothing below their own scatter."""
    noise = iter(1e-9 * rng.normal(size=1000))
    loss = Loss("noise", Params(()), np.zeros(1), lambda x: 1.0 + next(noise), lambda x: (1.0, np.zeros(1)), 1.0)
    flat = check_direction("a", loss, 1.0, np.array([1e-9]), np.ones(1), "float64")
    assert flat.agrees
    assert flat.noise >= abs(flat.differences)
    assert not check_direction("a", loss, 1.0, np.array([1.0]), np.ones(1), "float64").agrees
