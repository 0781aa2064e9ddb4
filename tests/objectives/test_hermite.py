"""Interpolation between control steps: order, ends, rest before the release, and adjoint."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.objectives.hermite import interpolant


def cubic(rng, tau):
    """Return values and slopes of three cubics at tau, (T, 3, 1) each."""
    c = rng.normal(size=(4, 3))
    powers = np.stack([tau**k for k in range(4)], 1)
    slopes = np.stack([k * tau ** max(k - 1, 0) for k in range(4)], 1)
    return (powers @ c)[..., None], (slopes @ c)[..., None]


def test_cubics_and_their_derivatives_are_exact(rng):
    knots, tau = 0.1 * np.arange(11), rng.uniform(0, 1, 40)
    values, slopes = cubic(rng, np.r_[knots, tau])
    at = interpolant(tau, 0.1, 10)
    np.testing.assert_allclose(at(values[:11], slopes[:11]), values[11:], atol=1e-14)
    np.testing.assert_allclose(at.slope(values[:11], slopes[:11]), slopes[11:], atol=1e-12)


def test_error_is_of_fourth_order():
    tau = np.linspace(0, 1, 173)
    errors = []
    for steps in (10, 20):
        knots = np.linspace(0, 1, steps + 1)
        y, w = np.sin(6 * knots)[:, None, None], 6 * np.cos(6 * knots)[:, None, None]
        errors.append(np.abs(interpolant(tau, 1 / steps, steps)(y, w)[:, 0, 0] - np.sin(6 * tau)).max())
    assert np.log2(errors[0] / errors[1]) > 3.8


def test_ends_and_rest_before_the_release(rng):
    y, w = rng.normal(size=(2, 5, 2, 3))
    at = interpolant(np.array([-0.3, 0.0, 0.1, 0.4, 0.4 + 1e-9]), 0.1, 4)
    np.testing.assert_allclose(at(y, w), y[[0, 0, 1, 4, 4]], atol=1e-7)
    np.testing.assert_allclose(at.slope(y, w), [0 * w[0], w[0], w[1], w[4], w[4]], atol=1e-6)
    with pytest.raises(ValueError, match=r"after the rollout's end at 0.4 s"):
        interpolant(np.array([0.41]), 0.1, 4)


def test_adjoint_by_dot_product(rng):
    y, w = rng.normal(size=(2, 7, 2, 3))
    at = interpolant(rng.uniform(-0.1, 0.6, 20), 0.1, 6)
    out_bar = rng.normal(size=(20, 2, 3))
    y_bar, w_bar = at.vjp(out_bar)
    assert np.sum(y_bar * y) + np.sum(w_bar * w) == pytest.approx(np.sum(out_bar * at(y, w)), rel=1e-12)
