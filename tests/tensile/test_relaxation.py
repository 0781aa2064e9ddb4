"""Relaxation tests: the branches that made a test are found, also with a ramp, and what it cannot tell is said."""

from __future__ import annotations

import numpy as np
import pytest
from made_pulls import curve, pull, write

from cqrun.errors import DataError, UsageError
from cqrun.tensile.branches import branch
from cqrun.tensile.curve import Curve, Given
from cqrun.tensile.laws import all_laws
from cqrun.tensile.outputs import as_json, fragment_text
from cqrun.tensile.reading import read_curves
from cqrun.tensile.relaxation import fit_relaxation, is_relaxation

RAMP, HELD = 0.5, 0.2


def relaxing(moduli, times, time, ramp=RAMP, noise=0.0, seed=2):
    """Return a test that is pulled at a constant rate, and then held."""
    strain = HELD * np.minimum(time / ramp, 1.0) if ramp else np.full(len(time), HELD)
    stress = strain.copy()
    for g, t in zip(moduli, times, strict=True):  # the exact answer to a ramp that ends
        rate = HELD / ramp if ramp else 0.0
        rising = rate * t * -np.expm1(-np.minimum(time, ramp) / t) if ramp else HELD * np.ones(len(time))
        stress = stress + g * rising * np.exp(-np.maximum(time - ramp, 0.0) / t)
    stress = 1e5 * stress * (1.0 + noise * np.random.default_rng(seed).standard_normal(len(time)))
    return Curve("relax.csv", "uniaxial", 1.0 + strain, stress, np.arange(len(time)), time)


TIME = np.r_[np.linspace(0.0, 2.0, 200), np.geomspace(2.05, 1000.0, 200)]


@pytest.mark.parametrize("ramp", [0.0, 0.5, 2.0])
def test_the_branches_that_made_a_test_are_found(ramp):
    fit = fit_relaxation(relaxing([0.3, 0.15], [1.5, 60.0], TIME, ramp))
    assert fit.prony.moduli == pytest.approx([0.3, 0.15], rel=0.01)
    assert fit.prony.times == pytest.approx([1.5, 60.0], rel=0.01)
    assert fit.long_term == pytest.approx(1e5 * HELD, rel=1e-3)
    assert fit.findings == ()
    assert "instantaneous modulus = 1.45 times the long-term one" in " ".join(fit.sentences())


def test_noise_makes_no_branches():
    fit = fit_relaxation(relaxing([0.3, 0.15], [1.5, 60.0], TIME, noise=0.005))
    assert len(fit.prony.times) == 2
    assert fit.prony.moduli == pytest.approx([0.3, 0.15], rel=0.1)
    assert fit.rms == pytest.approx(0.005, rel=0.3)


def test_intervals_of_branches_hold_the_truth():
    """95 % intervals of 40 tests with noise of 0.5 %: of 160 numbers at least 140 lie in theirs, which are narrow."""
    truth, inside = {"ratio_1": 0.3, "ratio_2": 0.15, "time_1": 1.5, "time_2": 60.0}, 0
    for seed in range(40):
        found = fit_relaxation(relaxing([0.3, 0.15], [1.5, 60.0], TIME, noise=0.005, seed=seed)).prony.intervals
        assert found.keys() == truth.keys()
        inside += sum(low < truth[name] < high for name, (low, high) in found.items())
        assert found["ratio_1"][1] < 1.2 * found["ratio_1"][0]
    assert inside >= 140


def test_a_time_that_the_test_cannot_tell_has_no_interval():
    """The branch is ten times as slow as the test is long; its time ends where times are no longer sought."""
    found = fit_relaxation(relaxing([1.0], [2000.0], np.linspace(0.0, 200.0, 400), noise=0.001)).prony.intervals
    assert found["time_1"] is None


def test_intervals_are_told(tmp_path):
    fit = fit_relaxation(relaxing([0.3], [1.5], TIME, noise=0.005))
    (low, high), (short, long) = fit.prony.intervals["ratio_1"], fit.prony.intervals["time_1"]
    told = (
        f"{fit.prony.moduli[0]:.3g} ({low:.3g} to {high:.3g}) at {fit.prony.times[0]:.3g} ({short:.3g} to {long:.3g}) s"
    )
    assert told in " ".join(fit.sentences())
    assert told in " ".join(line.removeprefix("#").strip() for line in fragment_text(None, [fit]).splitlines())
    assert as_json(None, [fit])["prony_intervals"]["ratio_1"] == [low, high]


def test_a_branch_follows_a_ramp_exactly():
    """h' = s' - h / t with s' constant: h = s' t (1 - exp(-time / t))."""
    time = np.linspace(0.0, 3.0, 7)
    assert branch(time, 0.5 * time, 0.8) == pytest.approx(0.5 * 0.8 * -np.expm1(-time / 0.8), rel=1e-12)


def test_times_longer_than_the_test_and_shorter_than_its_samples_are_told():
    slow = fit_relaxation(relaxing([0.3], [800.0], np.linspace(0.0, 1000.0, 400)))
    assert any("is not over at the end of the test" in text for text in slow.findings)
    fast = fit_relaxation(relaxing([0.4, 0.2], [0.5, 100.0], np.linspace(0.0, 1000.0, 400), ramp=0.0))
    assert any("faster than the test can tell" in text for text in fast.findings)


def test_a_strain_that_is_held_from_the_start_is_a_relaxation_whose_stress_hardly_falls():
    slow = relaxing([0.3], [5000.0], np.linspace(0.0, 100.0, 200), ramp=0.0)
    assert is_relaxation(slow)
    with pytest.raises(DataError, match=r"falls by 0\.5% while the strain is held: no relaxation can be told; hold it"):
        fit_relaxation(slow)


def test_a_stress_that_stays_is_no_relaxation():
    still = relaxing([], [], TIME)
    assert not is_relaxation(still)
    with pytest.raises(DataError, match="while the strain is held: no relaxation"):
        fit_relaxation(still)


def test_a_pull_test_is_no_relaxation_test(tmp_path):
    (pulled,) = read_curves(pull(tmp_path), Given())
    assert not is_relaxation(pulled)
    law = all_laws(["gent"])[0]
    assert not is_relaxation(curve(law, [1e5, 30.0], np.linspace(1.0, 2.0, 50)))


def test_time_and_force_alone_are_a_relaxation_test(tmp_path):
    made = relaxing([0.25], [5.0], np.linspace(0.0, 60.0, 300), ramp=0.0)
    columns = {"Time (s)": made.time, "Force (N)": made.stress * 18e-6}
    (read,) = read_curves(write(tmp_path, columns, header=["Tensile relaxation", "Area (mm2);18"]), Given())
    assert is_relaxation(read)
    fit = fit_relaxation(read)
    assert (fit.prony.moduli, fit.prony.times) == (pytest.approx([0.25], rel=0.01), pytest.approx([5.0], rel=0.01))
    assert "what relaxes while the specimen is pulled is missing in the branches" in fit.findings[0]


def written(folder, made, unit="s", factor=1.0):
    columns = {f"Time ({unit})" if unit else "Time": made.time / factor, "Strain (%)": 100 * (made.stretch - 1.0),
               "Stress (kPa)": made.stress * 1e-3}  # fmt: skip
    (read,) = read_curves(write(folder, columns, header=["Tensile relaxation"], name="relax.csv"), Given())
    return read


@pytest.mark.parametrize("column", ["stress", "stretch", "time"])
def test_a_line_without_a_number_is_removed_and_the_test_still_relaxes(tmp_path, column):
    made = relaxing([0.3, 0.15], [1.5, 60.0], TIME)
    getattr(made, column)[[250, 399]] = np.nan
    read = written(tmp_path, made)
    assert is_relaxation(read)
    fit = fit_relaxation(read)
    assert fit.prony.moduli == pytest.approx([0.3, 0.15], rel=0.01)
    assert "2 lines without numbers removed (first: relax.csv:253)" in fit.curve.remarks


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_return_of_the_crosshead_is_removed(tmp_path, sign):
    held = relaxing([0.3, 0.15], [1.5, 60.0], TIME)
    seconds = np.linspace(0.1, 20.0, 50)
    back = HELD * np.maximum(0.0, 1.0 - seconds)
    stretch = 1.0 + sign * np.r_[held.stretch - 1.0, back]
    stress = sign * np.r_[held.stress, 0.9e5 * back - 200.0]
    made = Curve("", "uniaxial", stretch, stress, np.arange(450), np.r_[TIME, 1000.0 + seconds])
    read = written(tmp_path, made)
    assert is_relaxation(read)
    fit = fit_relaxation(read)
    assert fit.prony.moduli == pytest.approx([0.3, 0.15], rel=0.01)
    assert fit.strain == pytest.approx(sign * HELD)
    assert "50 points after the hold removed: from line 403 on the strain is not held any more" in fit.curve.remarks


def test_a_strain_that_overshoots_or_is_reached_slowly_is_held_where_it_stays():
    made = relaxing([0.3], [5.0], np.linspace(0.0, 100.0, 500), ramp=60.0)
    assert not is_relaxation(made)  # most of the time it is pulled
    fit = fit_relaxation(made)
    assert fit.held_from == pytest.approx(60.0, abs=2.0)
    assert (fit.prony.moduli, fit.prony.times) == (pytest.approx([0.3], rel=0.01), pytest.approx([5.0], rel=0.01))
    over = relaxing([], [], TIME)
    over.stretch[195:205] *= 1.01
    over = Curve(**{**vars(over), "stress": np.exp(-TIME / 5.0) + 1.0})
    assert fit_relaxation(over).strain == pytest.approx(HELD)


def test_tests_without_times_or_strain_are_refused(tmp_path):
    made = relaxing([0.3], [5.0], np.linspace(0.0, 100.0, 50))
    with pytest.raises(DataError, match=r"a relaxation test needs times.* --column time=1"):
        fit_relaxation(Curve(**{**vars(made), "time": None}))
    with pytest.raises(DataError, match="the strain is zero at all points"):
        fit_relaxation(Curve(**{**vars(made), "stretch": np.ones(50)}))


UNITS = {"min": 60.0, "Minutes": 60.0, "hr": 3600.0, "h": 3600.0, "ms": 1e-3, "µs": 1e-6, "us": 1e-6, "Sek.": 1.0}


@pytest.mark.parametrize("unit", UNITS)
def test_units_of_time_are_known(tmp_path, unit):
    made = relaxing([0.3], [5.0], np.linspace(0.0, 100.0, 100))
    read = written(tmp_path, made, unit, UNITS[unit])
    assert read.time == pytest.approx(made.time)
    assert f"time: column 1 'Time' in {unit.replace('µ', 'u')}" in read.remarks[0]


def test_a_time_without_a_known_unit_is_told_or_asked_for(tmp_path):
    made = relaxing([0.3], [5.0], np.linspace(0.0, 100.0, 100))
    assert any("the time has no unit and is read as seconds" in text for text in written(tmp_path, made, "").remarks)
    with pytest.raises(
        DataError, match=r"has the unit 'ticks', which is not one of a time: .* --unit time=min \(s, min"
    ):
        written(tmp_path, made, "ticks")
    with pytest.raises(UsageError, match="--unit time=ticks: the units of a time are s, min, h"):
        read_curves(tmp_path / "relax.csv", Given(units={"time": "ticks"}))
    (read,) = read_curves(tmp_path / "relax.csv", Given(units={"time": "min"}))
    assert read.time == pytest.approx(60.0 * made.time)
