"""Intervals: they cover the truth as often as they say, with white and with correlated noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cqrun.fitting.identifiability import Unknown, follow
from cqrun.fitting.uncertainty import Series, autocorrelation_time, central_jacobian, intervals

TRUTH = {"amplitude": 1.0, "decay": 1.2, "frequency": 8.0}
TIME = np.linspace(0, 2, 120)
FRAMES = np.arange(TIME.size)
SERIES = [Series(k * TIME.size + FRAMES, FRAMES, 0) for k in range(3)]


def swing(values):
    """Return three coordinates of a damped swing, one after the other."""
    a, b, c = values
    decay = np.exp(-b * TIME)
    return a * np.concatenate([decay * np.cos(c * TIME), 1 - decay * np.cos(c * TIME), 0.3 * decay * np.sin(c * TIME)])


def unknowns_at(values, log=True):
    return [Unknown(name, value, value / 10, value * 10, log) for name, value in zip(TRUTH, values, strict=True)]


def jacobian_at(values, log=True):
    return central_jacobian(lambda points: [swing(point) for point in points], unknowns_at(values, log))


def fit(data):
    """Return the least-squares values, by Gauss and Newton from the truth."""
    values = np.array(list(TRUTH.values()))
    for _ in range(6):
        values = values * np.exp(np.linalg.lstsq(jacobian_at(values), data - swing(values), rcond=None)[0])
    return values


def noise(rng, phi):
    """Return an autoregression of unit variance in each of the three coordinates, (3, T)."""
    e = rng.normal(size=(3, TIME.size))
    for i in range(1, TIME.size):
        e[:, i] = phi * e[:, i - 1] + np.sqrt(1 - phi**2) * e[:, i]
    return e


@pytest.mark.parametrize("phi", [0.0, 0.7])
@pytest.mark.parametrize("log", [True, False])
def test_95_percent_intervals_cover_the_truth(rng, phi, log):
    covered = []
    for _ in range(250):
        data = swing(TRUTH.values()) + (np.array([[0.05], [0.05], [0.01]]) * noise(rng, phi)).ravel()
        values = fit(data)
        found = intervals(jacobian_at(values, log), swing(values) - data, SERIES, unknowns_at(values, log)).intervals
        covered.append([found[name][0] <= true <= found[name][1] for name, true in TRUTH.items()])
    assert np.all(np.mean(covered, axis=0) >= 0.90)
    assert np.all(np.mean(covered, axis=0) <= 0.99)


@pytest.mark.parametrize("phi", [0.0, 0.7])
def test_intervals_cover_the_truth_where_markers_err_together(rng, phi):
    """Six markers on a stiff body with one error for all: taken as independent they would cover half the time."""
    count = 6
    series = [Series(k * 3 * TIME.size + s.where, s.frames, 0) for k in range(count) for s in SERIES]
    covered, alone = [], []
    for _ in range(250):
        together = np.array([[0.05], [0.05], [0.01]]) * noise(rng, phi)
        own = [0.2 * np.array([[0.05], [0.05], [0.01]]) * noise(rng, phi) for _ in range(count)]
        data = np.concatenate([swing(TRUTH.values()) + (together + each).ravel() for each in own])
        values = fit(data.reshape(count, -1).mean(axis=0))
        J, r = np.tile(jacobian_at(values), (count, 1)), np.tile(swing(values), count) - data
        for into, which in ((covered, series), (alone, [replace(s, recording=k) for k, s in enumerate(series)])):
            found = intervals(J, r, which, unknowns_at(values)).intervals
            into.append([found[name][0] <= true <= found[name][1] for name, true in TRUTH.items()])
    assert np.all(np.mean(covered, axis=0) >= 0.90)
    assert np.all(np.mean(covered, axis=0) <= 0.99)
    assert np.all(np.mean(alone, axis=0) <= 0.75)


def test_series_with_gaps_are_compared_where_both_are_seen(rng):
    """A marker that is hidden for a while errs with its neighbour all the same."""
    values, seen = list(TRUTH.values()), FRAMES[(FRAMES < 40) | (FRAMES > 70)]
    error = rng.normal(size=TIME.size)
    J, r = rng.normal(size=(TIME.size + seen.size, 3)), np.concatenate([error, error[seen]])
    pair = [Series(FRAMES, FRAMES, 0), Series(TIME.size + np.arange(seen.size), seen, 0)]
    J[TIME.size :] = J[: TIME.size][seen]
    one = intervals(J, r, pair, unknowns_at(values))
    other = intervals(J, r, [replace(s, recording=k) for k, s in enumerate(pair)], unknowns_at(values))
    for name in TRUTH:
        (low, high), (low_alone, high_alone) = one.intervals[name], other.intervals[name]
        assert np.log(high / low) == pytest.approx(np.sqrt(2) * np.log(high_alone / low_alone), rel=0.15)


def test_a_straight_line_gives_the_textbook_interval(rng):
    x, e = np.linspace(-1, 1, 400), 0.1 * rng.normal(size=400)
    design = np.stack([np.ones(400), x], 1)
    values, *_ = np.linalg.lstsq(design, 2 + 3 * x + e, rcond=None)
    r = design @ values - (2 + 3 * x + e)
    series, unknowns = Series(np.arange(400), np.arange(400), 0), zip("ab", values, strict=True)
    found = intervals(design, r, [series], [Unknown(n, v, -9, 9) for n, v in unknowns])
    half = 1.966 * np.sqrt(r @ r / 398 * np.diag(np.linalg.inv(design.T @ design)))
    for name, value, width in zip("ab", values, half, strict=True):
        np.testing.assert_allclose(found.intervals[name], (value - width, value + width), rtol=0.15 * width / value)
    assert found.reasons == {}


def test_scale_of_the_residuals_does_not_matter(rng):
    values = list(TRUTH.values())
    r = 0.05 * rng.normal(size=360)
    one = intervals(jacobian_at(values), r, SERIES, unknowns_at(values))
    other = intervals(1e3 * jacobian_at(values), 1e3 * r, SERIES, unknowns_at(values))
    for name in TRUTH:
        np.testing.assert_allclose(one.intervals[name], other.intervals[name])


def test_log_intervals_are_symmetric_in_the_logarithm_and_positive(rng):
    values = list(TRUTH.values())
    found = intervals(jacobian_at(values), 0.3 * rng.normal(size=360), SERIES, unknowns_at(values))
    for name, value in TRUTH.items():
        low, high = found.intervals[name]
        assert 0 < low < value < high
        assert low * high == pytest.approx(value**2)


@pytest.mark.parametrize(("phi", "expected"), [(0.0, 1.0), (0.5, 3.0), (0.9, 19.0)])
def test_autocorrelation_time(rng, phi, expected):
    e = rng.normal(size=4000)
    for i in range(1, e.size):
        e[i] = phi * e[i - 1] + np.sqrt(1 - phi**2) * e[i]
    assert autocorrelation_time(e) == pytest.approx(expected, rel=0.25)


def test_autocorrelation_time_is_robust(rng):
    assert autocorrelation_time(np.zeros(50)) == 1.0
    assert autocorrelation_time(rng.normal(size=3)) == 1.0
    assert autocorrelation_time(np.ones(50)) == 50.0
    assert autocorrelation_time((-1.0) ** np.arange(50)) == 1.0


def test_jacobian_is_the_derivative_in_working_coordinates():
    a, b, c = TRUTH.values()
    exact = np.exp(-b * TIME) * np.cos(c * TIME)
    logarithmic, linear = jacobian_at(TRUTH.values()), jacobian_at(TRUTH.values(), log=False)
    np.testing.assert_allclose(logarithmic[:120, 0], a * exact, atol=1e-6)
    np.testing.assert_allclose(linear[:120, 1], -a * TIME * exact, atol=1e-4)
    np.testing.assert_allclose(logarithmic[:120, 1], -a * b * TIME * exact, atol=1e-6)


def test_all_points_of_the_jacobian_are_asked_for_at_once_and_inside_the_bounds():
    asked = []

    def evaluate(points):
        asked.append(np.array(points))
        return [swing(point) for point in points]

    near = [
        Unknown("a", 1.0, 0.9999, 2.0, True),
        Unknown("b", 1.2, 1.2, 3.0, True),
        Unknown("c", 8.0, 7.0, 9.0),
    ]
    J = central_jacobian(evaluate, near)
    (points,) = asked
    assert points.shape == (4, 3)
    assert points[:, 0].min() >= 0.9999 - 1e-15
    assert not J[:, 1].any()
    assert J[:, 0].any()


# ---------------------------------------------------------------- no interval, and why


def test_at_a_bound(rng):
    J, r = rng.normal(size=(360, 2)), rng.normal(size=360)
    for value, end in ((0.0, "lower"), (1.0, "upper")):
        found = intervals(J, r, SERIES, [Unknown("friction", value, 0, 1), Unknown("b", 0.5, 0, 1)])
        assert found.intervals["friction"] is None
        assert found.reasons == {"friction": f"at its {end} bound"}
        assert found.intervals["b"] is not None


def test_all_at_a_bound(rng):
    unknowns = [Unknown("a", 0.0, 0, 1), Unknown("b", 2.0, 1, 2, True)]
    J = central_jacobian(lambda points: [swing(point) for point in points], unknowns)
    found = intervals(J, rng.normal(size=360), SERIES, unknowns)
    assert found.intervals == {"a": None, "b": None}
    assert found.reasons == {"a": "at its lower bound", "b": "at its upper bound"}


def test_too_many_unknowns_and_too_few_residuals(rng):
    many = [Unknown(f"u{i}", 0.5, 0, 1) for i in range(31)]
    found = intervals(rng.normal(size=(360, 31)), rng.normal(size=360), SERIES, many)
    assert set(found.intervals.values()) == {None}
    assert set(found.reasons.values()) == {"more than 30 unknowns"}
    found = intervals(rng.normal(size=(3, 3)), rng.normal(size=3), [Series(np.arange(3), np.arange(3), 0)], many[:3])
    assert found.reasons["u0"] == "no more residuals than unknowns"


def test_flat_unknown(rng):
    J = np.stack([rng.normal(size=360), np.zeros(360)], 1)
    found = intervals(J, rng.normal(size=360), SERIES, [Unknown("E", 2e5, 1e5, 1e6, True), Unknown("mu", 0.5, 0, 1)])
    assert found.intervals["mu"] is None
    assert found.reasons == {"mu": "the data do not depend on it"}
    assert any(f.startswith("mu: the data do not depend on it; fix it") for f in found.findings)
    assert found.intervals["E"] is not None
    assert np.isnan(found.covariance[1]).all()


def test_modulus_and_density_under_gravity_alone_are_named(rng):
    ratio, other = rng.normal(size=(2, 360))
    J = np.stack([ratio, -ratio + 1e-7 * rng.normal(size=360), other], 1)
    unknowns = [
        Unknown("E", 2e5, 1e5, 1e6, True),
        Unknown("density", 1e3, 5e2, 2e3, True),
        Unknown("nu", 0.3, 0, 0.49),
    ]
    found = intervals(J, rng.normal(size=360), SERIES, unknowns)
    assert found.intervals["E"] is found.intervals["density"] is None
    assert found.intervals["nu"] is not None
    (finding,) = found.findings
    assert "E" in finding
    assert "density" in finding
    assert "cannot be told apart" in finding
    assert finding.count("by +1 %") == 2
    assert "nu" not in finding
    assert found.reasons["E"] == "cannot be told apart from other unknowns"


def test_a_combination_on_a_linear_scale_says_how_much(rng):
    column = rng.normal(size=360)
    unknowns = [Unknown("E", 2e5, 1e5, 1e6, True), Unknown("start", 0.7, 0.6, 0.8)]
    found = intervals(np.stack([column, 4 * column], 1), rng.normal(size=360), SERIES, unknowns)
    (finding,) = found.findings
    changes = ("E by +1 % and start by -0.0025", "start by +0.002 and E by -0.8 %")
    assert any(change in finding for change in changes)


def test_barely_told_apart_and_wider_than_the_bounds(rng):
    ratio, other = rng.normal(size=(2, 360))
    J = np.stack([ratio, ratio + 0.05 * other], 1)
    unknowns = [Unknown("E", 0.5, 0, 1), Unknown("eta", 0.5, 0, 1)]
    found = intervals(J, 0.01 * rng.normal(size=360), SERIES, unknowns)
    assert any("E and eta are hard to tell apart (correlation -0.99" in f for f in found.findings)
    assert None not in found.intervals.values()
    found = intervals(J, 30 * rng.normal(size=360), SERIES, unknowns)
    assert any(f.startswith("eta: its interval is wider than its bounds") for f in found.findings)


def test_where_the_optimum_goes_when_residuals_change(rng):
    """It is exact for a linear fit, within bounds; an unknown at its bound, whose column is zero, stays."""
    J, z = np.c_[rng.normal(size=(40, 2)), np.zeros(40)], np.array([0.3, np.log(2.0), 1.0])
    r = rng.normal(size=40)
    unknowns = [Unknown("a", 0.3, -9, 9), Unknown("E", 2.0, 0.1, 100, True), Unknown("c", 1.0, 0, 1)]
    best = z - np.linalg.lstsq(J, r, rcond=None)[0]
    np.testing.assert_allclose(follow(J, r, unknowns), [best[0], np.exp(best[1]), 1.0], rtol=1e-12)
    bound = 1.9 if best[1] < z[1] else 2.1  # between the value and where it would go
    assert abs(np.log(bound) - z[1]) < abs(best[1] - z[1])
    unknowns[1] = Unknown("E", 2.0, min(bound, 1.99), max(bound, 2.01), True)
    alone = 0.3 - J[:, 0] @ (r + J[:, 1] * (np.log(bound) - z[1])) / (J[:, 0] @ J[:, 0])
    np.testing.assert_allclose(follow(J, r, unknowns), [alone, bound, 1.0], rtol=1e-12)


@pytest.mark.parametrize(("value", "end"), [(0.51, "lower bound, 0.5"), (1.99, "upper bound, 2")])
def test_an_interval_past_a_bound_is_told(rng, value, end):
    J = rng.normal(size=(360, 1))
    for noise, told in ((1.0, 1), (0.01, 0)):
        found = intervals(J, noise * rng.normal(size=360), SERIES, [Unknown("viscosity", value, 0.5, 2.0, True)])
        assert len(found.findings) == told
        assert all(f"reaches past its {end}: the data allow values that the bounds do not" in f for f in found.findings)


def test_open_by_hundreds_of_powers_of_ten(rng):
    J = np.stack([rng.normal(size=360), 1e-5 * rng.normal(size=360)], 1)
    unknowns = [Unknown("E", 2e5, 1e5, 1e6, True), Unknown("eta", 1.0, 0.1, 10, True)]
    found = intervals(J, rng.normal(size=360), SERIES, unknowns)
    assert found.intervals["eta"] is None
    assert "powers of ten" in found.reasons["eta"]


def test_no_noise_gives_intervals_of_no_width():
    values = list(TRUTH.values())
    found = intervals(jacobian_at(values), np.zeros(360), SERIES, unknowns_at(values))
    for name, value in TRUTH.items():
        np.testing.assert_allclose(found.intervals[name], (value, value))
