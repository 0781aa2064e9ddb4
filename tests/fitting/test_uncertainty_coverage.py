"""Intervals cover the truth where errors are slow, constant or shared, and where the still mean errs."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.fitting.identifiability import Unknown
from cqrun.fitting.uncertainty import Series, intervals

N, TRIALS = 120, 120
TIME = np.linspace(0, 1, N)
SAG = 1 - np.exp(-3 * TIME) * np.cos(15 * TIME)
SWING = np.exp(-TIME) * np.sin(15 * TIME)
SLACK = 2.5 * np.sqrt(0.95 * 0.05 / TRIALS)
"""By this much a coverage of 95 % may seem less in so many trials, one time in 200."""


def autoregression(rng, phi, shape):
    """Return first-order autoregressions of unit variance along the last axis."""
    e = rng.normal(size=shape)
    for i in range(1, shape[-1]):
        e[..., i] = phi * e[..., i - 1] + np.sqrt(1 - phi**2) * e[..., i]
    return e


def series_of(count, n, still=None):
    frames = np.arange(n)
    still = np.zeros((count, 0)) if still is None else still
    return [Series(k * n + frames, frames, 0, still[k]) for k in range(count)]


def fit(J, errors, series):
    """Return how far each unknown of a linear fit is off, and what its interval says."""
    off = np.linalg.lstsq(J, errors.ravel(), rcond=None)[0]
    unknowns = [Unknown(f"u{i}", float(x), -1e5, 1e5) for i, x in enumerate(off)]
    return off, intervals(J, J @ off - errors.ravel(), series, unknowns)


def cover(J, draw, rng):
    """Return by unknown how often intervals cover zero, and the reported over the true standard deviation."""
    hits, told, true = [], [], []
    for _ in range(TRIALS):
        off, found = fit(J, *draw(rng))
        hits.append([low <= 0 <= high for low, high in found.intervals.values()])
        told.append(np.diag(found.covariance))
        true.append(off)
    return np.mean(hits, axis=0), np.sqrt(np.mean(told, axis=0)) / np.std(true, axis=0)


@pytest.mark.parametrize(("phi", "count"), [(0.7, 6), (0.9, 6), (0.97, 6), (0.99, 6)])
def test_slow_errors_that_markers_share(rng, phi, count):
    """With six markers the intervals of independent errors would cover a third of the time at phi = 0.99."""

    def draw(rng):
        return autoregression(rng, phi, (N,)) + 0.1 * rng.normal(size=(count, N)), series_of(count, N)

    covered, told = cover(np.tile(SAG, count)[:, None], draw, rng)
    assert 0.95 - SLACK <= covered[0] <= 0.995
    assert 0.9 < told[0] < 2.0


def test_slow_errors_leave_a_frequency_known(rng):
    """A slow error looks like a sag, not like a swing: it makes only the first less certain."""

    def draw(rng):
        return autoregression(rng, 0.97, (N,)) + 0.05 * rng.normal(size=(6, N)), series_of(6, N)

    covered, told = cover(np.tile(np.stack([SAG, SWING], 1), (6, 1)), draw, rng)
    assert np.all(covered >= 0.95 - SLACK)
    assert 0.9 < told[1] < 2.0


@pytest.mark.parametrize(("count", "frames", "jitter"), [(6, 25, 0.05), (6, 100, 0.5), (18, 25, 0.2)])
def test_constant_errors_of_a_body_at_rest(rng, count, frames, jitter):
    """More frames of an error that stays tell no more of it than one does."""
    J = np.repeat(rng.uniform(0.3, 1, count), frames)[:, None]

    def draw(rng):
        return rng.normal(size=(count, 1)) + jitter * rng.normal(size=(count, frames)), series_of(count, frames)

    covered, told = cover(J, draw, rng)
    assert 0.95 - SLACK <= covered[0] <= 0.995
    assert 0.85 < told[0] < 1.3


@pytest.mark.parametrize("error", [np.sin(2 * np.pi * TIME + 0.3), np.cos(np.pi * TIME + 0.2), np.ones(N)])
def test_markers_that_err_identically_tell_what_one_tells(error):
    found = []
    for count in (1, 6):
        J, r = np.tile(0.5 + TIME, count)[:, None], np.tile(error, count)
        found.append(intervals(J, r, series_of(count, N), [Unknown("E", 0.0, -1e3, 1e3)]))
    one, six = found
    np.testing.assert_allclose(six.covariance, one.covariance, rtol=1e-6)
    np.testing.assert_allclose(six.degrees, one.degrees, rtol=1e-6)


@pytest.mark.parametrize("frames", [5, 15, 50, 150])
def test_the_still_mean_errs_too(rng, frames):
    """Its error is an offset of a whole series, which the sag's unknown takes up and the swing's does not."""
    count = 3

    def draw(rng):
        still = rng.normal(size=(count, frames))
        mean = still.mean(axis=1, keepdims=True)
        return rng.normal(size=(count, N)) - mean, series_of(count, N, still - mean)

    scale = np.array([1.0, 0.97, 0.94])
    J = np.stack([np.outer(scale, SAG).ravel(), np.outer(scale, SWING).ravel()], 1)
    covered, told = cover(J, draw, rng)
    assert np.all(covered >= 0.95 - SLACK)
    assert np.all(told > 0.9)
    assert np.all(told < 2.0)


def test_white_errors_leave_intervals_what_they_are(rng):
    """Independent errors of unit variance: the textbook's standard deviations, but for what memory chance shows."""
    J = np.tile(np.stack([SAG, SWING], 1), (6, 1))
    told = [np.diag(fit(J, rng.normal(size=(6, N)), series_of(6, N))[1].covariance) for _ in range(60)]
    ratio = np.sqrt(np.mean(told, axis=0) / np.diag(np.linalg.inv(J.T @ J)))
    assert np.all((ratio > 0.95) & (ratio < 1.2))
