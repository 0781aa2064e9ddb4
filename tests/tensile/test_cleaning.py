"""What is not the first loading of one specimen is removed and reported, or refused."""

from __future__ import annotations

import numpy as np
import pytest
from made_pulls import pull, silicone, write

from cqrun.errors import DataError
from cqrun.tensile.cleaning import clean
from cqrun.tensile.curve import EVERY, Given
from cqrun.tensile.reading import read_curves
from cqrun.tensile.slack import find_slack

STRAIN = np.linspace(0.0, 2.0, 101)


def cleaned(path, given=None):
    given = given or Given()
    (curve,) = read_curves(path, given)
    return clean(curve, given)


def said(curve, words):
    return any(words in remark for remark in curve.remarks)


def test_a_clean_test_stays_as_it_is(tmp_path):
    curve = cleaned(pull(tmp_path, STRAIN))
    assert curve.stretch == pytest.approx(1.0 + STRAIN)
    assert len(curve.remarks) == 2  # which columns, and the mode
    assert said(curve, "read as engineering strain: column 1")
    assert said(curve, "uniaxial, as the header says")


def test_rows_without_numbers_are_removed(tmp_path):
    stress = silicone(STRAIN)
    stress[[3, 50]] = np.nan
    curve = cleaned(pull(tmp_path, STRAIN, stress))
    assert len(curve.stretch) == 99
    assert said(curve, "2 lines without numbers removed (first: pull.csv:6)")


@pytest.mark.parametrize(("n", "message"), [(1, "one point"), (2, "2 points")])
def test_too_few_points_are_refused(tmp_path, n, message):
    with pytest.raises(DataError, match=f"has {message} that can be used; a curve needs at least 3"):
        cleaned(pull(tmp_path, STRAIN[10 : 10 + n]))


def test_points_at_one_strain_are_refused(tmp_path):
    with pytest.raises(DataError, match="at one strain"):
        cleaned(pull(tmp_path, np.full(5, 0.5)))


def test_unloading_is_cut_unless_it_is_kept(tmp_path):
    strain = np.r_[STRAIN[:51], STRAIN[49:20:-1], STRAIN[20:]]
    stress = silicone(strain)
    stress[51:111] *= 0.8  # softer until it is stretched further than before
    path = pull(tmp_path, strain, stress)
    curve = cleaned(path)
    assert curve.stretch == pytest.approx(1.0 + np.unique(STRAIN))
    assert curve.stress == pytest.approx(silicone(STRAIN), rel=1e-6, abs=1.0)
    assert said(curve, "points of unloading and reloading removed (first: line 54)")
    kept = cleaned(path, Given(unloading="keep"))
    assert len(kept.stretch) == len(strain)
    assert said(kept, "unloading is kept")


def test_slack_at_the_start_is_moved_unless_the_strain_is_optical(tmp_path):
    taut = np.maximum(STRAIN - 0.05, 0.0)
    columns = {"Strain (1)": STRAIN, "Stress (MPa)": silicone(taut) * 1e-6}
    curve = cleaned(write(tmp_path, columns, header=["ASTM D412"]))
    assert curve.stretch[0] == pytest.approx(1.0, abs=0.02)
    assert curve.stress == pytest.approx(silicone(curve.stretch - 1.0), abs=2500.0)  # of 260 kPa
    assert said(curve, "slack at the start: strain counts from")
    optical = {"Video strain (1)": STRAIN, "Stress (MPa)": silicone(taut) * 1e-6}
    assert not said(cleaned(write(tmp_path, optical, header=["ASTM D412"])), "slack")
    given = cleaned(pull(tmp_path, STRAIN, silicone(taut)), Given(slack=0.05))
    assert given.stress == pytest.approx(silicone(given.stretch - 1.0), abs=1.0)
    assert len(cleaned(pull(tmp_path, STRAIN, silicone(taut)), Given(slack=0.0)).stretch) == len(STRAIN)


def test_no_slack_is_found_in_rubber_that_is_taut():
    assert find_slack(STRAIN, silicone(STRAIN)) == 0.0
    noisy = silicone(STRAIN) + 500.0 * np.random.default_rng(1).standard_normal(len(STRAIN))
    assert find_slack(STRAIN, noisy) == 0.0


@pytest.mark.parametrize("stress", [silicone(np.maximum(STRAIN - 0.15, 0.0)), 1e5 * STRAIN**2])
def test_slack_that_may_be_the_shape_of_the_material_is_told_and_not_moved(tmp_path, stress):
    """Much slack looks like a material that stiffens from the start."""
    path = pull(tmp_path, STRAIN, stress)
    curve = cleaned(path)
    assert curve.stretch == pytest.approx(1.0 + STRAIN)
    assert said(curve, "which is much for slack, so nothing is corrected: if the specimen was slack, give --slack 0.")
    assert not said(cleaned(path, Given(slack=0.0)), "slack")


def test_a_stress_of_zero_everywhere_is_refused(tmp_path):
    with pytest.raises(DataError, match="the stress is zero at all points"):
        cleaned(pull(tmp_path, STRAIN, 0.0 * STRAIN))


def test_a_specimen_that_slips_ends_the_curve(tmp_path):
    stress = silicone(STRAIN)
    stress[60:] -= 0.4 * stress[60]
    curve = cleaned(pull(tmp_path, STRAIN, stress))
    assert len(curve.stretch) == 60
    assert said(curve, "the specimen slips in its grips; the 41 points after it are not used")


def test_what_follows_failure_is_removed(tmp_path):
    stress = np.r_[silicone(STRAIN[:80]), 1000.0 * np.ones(21)]
    curve = cleaned(pull(tmp_path, STRAIN, stress))
    assert len(curve.stretch) == 80
    assert said(curve, "the specimen fails; 21 points after it removed")


@pytest.mark.parametrize("second", ["the same", "stiffer"])
def test_two_materials_in_one_file_are_refused(tmp_path, second):
    stress = np.r_[silicone(STRAIN), silicone(STRAIN) * (1.0 if second == "the same" else 3.0)]
    with pytest.raises(DataError, match=r"pull\.csv:104: the strain starts again here: two materials or specimens"):
        cleaned(pull(tmp_path, np.r_[STRAIN, STRAIN], stress))


def test_compression_with_a_wrong_sign_is_refused_until_it_is_named(tmp_path):
    strain = np.linspace(0.0, 0.5, 40)
    path = pull(tmp_path, strain, silicone(-strain))
    with pytest.raises(DataError, match=r"stress is negative where the strain is positive.*give --compression"):
        cleaned(path)
    right = silicone(-strain)
    for one in (path, pull(tmp_path, strain, -right, name="both.csv"), pull(tmp_path, -strain, right, name="ok.csv")):
        curve = cleaned(one, Given(compression=True))
        assert curve.stretch == pytest.approx(1.0 - strain)
        assert curve.stress == pytest.approx(right, abs=1.0)
    columns = {"Compressive strain (%)": 100 * strain, "Compressive stress (MPa)": -right * 1e-6}
    curve = cleaned(write(tmp_path, columns))
    assert curve.stress == pytest.approx(right, abs=1.0)
    assert said(curve, "this is a compression test, as the header says")


def test_tension_and_compression_in_one_curve_stay(tmp_path):
    strain = np.linspace(-0.4, 1.5, 60)
    curve = cleaned(pull(tmp_path, strain))
    assert curve.stretch == pytest.approx(1.0 + strain)


def test_a_range_of_strains_is_kept(tmp_path):
    curve = cleaned(pull(tmp_path, STRAIN), Given(span=(0.1, 1.0)))
    assert (curve.stretch.min(), curve.stretch.max()) == (pytest.approx(1.1), pytest.approx(2.0))
    with pytest.raises(DataError, match="no point"):
        cleaned(pull(tmp_path, STRAIN), Given(mode={EVERY: "uniaxial"}, span=(5.0, 6.0)))
