"""Noise of a load cell is no slip, single wrong points do not end a test, and slip and failure are found in noise."""

from __future__ import annotations

import numpy as np
import pytest
from made_pulls import silicone

from cqrun.tensile.curve import Curve
from cqrun.tensile.failure import without_failure, without_glitches
from cqrun.tensile.noise import noise_of
from cqrun.tensile.slack import find_slack


def stiffening(strain):
    """Return the stress [Pa] of a Yeoh law of E = 180 kPa in uniaxial tension."""
    l = 1.0 + strain  # noqa: E741
    return 2.0 * (3e4 + 600.0 * (l**2 + 2.0 / l - 3.0)) * (l - l**-2)


def made(stress, top, noise=0.0, seed=0):
    strain = np.linspace(0.0, top, len(stress))
    scatter = noise * stress.max() * np.random.default_rng(seed).standard_normal(len(stress))
    return Curve("pull.csv", "uniaxial", 1.0 + strain, stress + scatter, np.arange(2, len(stress) + 2))


def cut(curve):
    return without_failure(without_glitches(curve))


def slipped(points, at, by, top=2.0):
    strain = np.linspace(0.0, top, points)
    return stiffening(np.where(strain < at, strain, strain - by))


@pytest.mark.parametrize("noise", [0.003, 0.005, 0.01])
@pytest.mark.parametrize("points", [60, 500, 2000])
def test_noise_is_no_slip(noise, points):
    """Noise of 0.5 % of the largest stress is 15 % of the stress at small strains."""
    for seed in range(20):
        curve = made(stiffening(np.linspace(0.0, 5.0, points)), 5.0, noise, seed)
        assert len(cut(curve).stretch) == points
        assert cut(curve).remarks == ()


@pytest.mark.parametrize("points", [60, 200, 500, 2000])
def test_noise_is_no_slack_and_hides_none(points):
    strain = np.linspace(0.0, 2.0, points)
    for seed in range(20):
        assert find_slack(strain, made(stiffening(strain), 2.0, 0.003, seed).stress) == 0.0
        slack = find_slack(strain, made(stiffening(np.maximum(strain - 0.05, 0.0)), 2.0, 0.003, seed).stress)
        assert slack == pytest.approx(0.04, abs=0.02)  # the stress of a law softens, so a tangent finds too little


def test_the_noise_of_a_curve_is_told_from_its_shape():
    curve = made(stiffening(np.linspace(0.0, 5.0, 500)), 5.0, 0.005)
    assert noise_of(curve.stress) == pytest.approx(0.005 * stiffening(5.0), rel=0.15)
    assert noise_of(stiffening(np.linspace(0.0, 5.0, 40))) < 2e-4 * stiffening(5.0)
    assert noise_of(np.ones(3)) == 0.0


@pytest.mark.parametrize("noise", [0.0, 0.002])
@pytest.mark.parametrize(("value", "count"), [(1.25, 1), (0.0, 1), (0.0, 3)])
def test_wrong_points_are_removed_and_the_rest_of_the_test_stays(noise, value, count):
    stress = silicone(np.linspace(0.0, 2.0, 81))
    stress[30 : 30 + count] *= value
    curve = cut(made(stress, 2.0, noise))
    assert np.setdiff1d(np.arange(2, 83), curve.line).tolist() == list(range(32, 32 + count))
    (remark,) = curve.remarks
    assert remark.startswith(f"{count} point{'s' * (count > 1)} removed (first: line 32, ")


def test_no_point_of_a_slip_a_failure_or_a_toe_is_a_wrong_one():
    toe = silicone(np.maximum(np.linspace(-0.2, 2.0, 81), 0.0))
    failing = np.r_[silicone(np.linspace(0.0, 2.0, 80)), 100.0]
    for stress in (slipped(81, 1.25, 0.3), slipped(81, 0.3, 0.1), failing, toe):
        assert without_glitches(made(stress, 2.0)).remarks == ()


@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize(("points", "at", "by"), [(81, 1.24, 0.3), (81, 0.31, 0.1), (500, 1.24, 0.3)])
def test_a_slip_is_found_in_noise(noise, points, at, by):
    for seed in range(5):
        curve = cut(made(slipped(points, at, by), 2.0, noise, seed))
        assert curve.stretch.max() - 1.0 == pytest.approx(at, abs=0.04)
        assert "and grows again: the specimen slips in its grips" in curve.remarks[0]


def test_a_small_slip_is_mentioned_and_cuts_nothing():
    curve = cut(made(slipped(81, 1.24, 0.08), 2.0, 0.0005))
    assert len(curve.stretch) == 81
    assert curve.remarks == (
        "at strain 1.23 (line 51) the stress falls by 4% at once: the specimen may have slipped or torn a little "
        "there. The points after it are used; --range :1.23 leaves them out",
    )
