"""The frequency of motions that are known."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.jobs.studies.oscillation import frequency

TIME = np.linspace(0.0, 1.0, 61)


@pytest.mark.parametrize("rate", [2.1, 4.37, 9.0])
@pytest.mark.parametrize("damping", [0.0, 1.1, 3.0])
def test_a_damped_sine_has_its_frequency(rate, damping):
    y = -0.03 + 0.01 * np.exp(-damping * TIME) * np.cos(2 * np.pi * rate * TIME + 0.3)
    assert frequency(TIME, y) == pytest.approx(rate, rel=1e-6)
    assert frequency(TIME + 5.0, y) == pytest.approx(rate, rel=1e-6)


def test_a_second_mode_changes_it_little():
    y = np.exp(-TIME) * np.cos(2 * np.pi * 4.0 * TIME) + 0.1 * np.cos(2 * np.pi * 17.0 * TIME)
    assert frequency(TIME, y) == pytest.approx(4.0, rel=5e-3)


@pytest.mark.parametrize(
    "y",
    [
        TIME,  # drifts
        TIME**2,
        1 - np.exp(-5 * TIME),  # settles
        np.exp(-12 * TIME) * np.cos(2 * np.pi * 3 * TIME),  # is damped within a period
        np.cos(2 * np.pi * 1.5 * TIME),  # fewer than two periods
        np.cos(2 * np.pi * 25 * TIME),  # fewer than five samples a period
        np.zeros(61),
        np.full(61, np.nan),
        np.random.default_rng(0).normal(size=61),
    ],
)
def test_what_does_not_oscillate_has_none(y):
    assert frequency(TIME, y) is None


def test_too_few_samples_have_none():
    assert frequency(TIME[:5], np.cos(40 * TIME[:5])) is None
    assert frequency(TIME[:0], TIME[:0]) is None
