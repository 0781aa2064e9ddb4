"""What a fit takes as known is among its findings: bounds that it ended at, and numbers that the scene holds fixed."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from small_beam import E_PATH, SHEAR_PATH, changed, record, recorded, result_of

from cqrun.build.model import build
from cqrun.fitting.assumptions import _thin_on_the_grid, of_slow_errors, of_the_substep
from cqrun.fitting.uncertainty import Series
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.scene.load import load_scene

MATERIAL = "bodies.beam.material"
RATIO = f"{MATERIAL}.elastic.fixed_corotated.poissons_ratio"
DENSITY = f"{MATERIAL}.density"


def findings(scene, out, *overrides: str) -> tuple[dict[str, dict], list[str]]:
    """Return the unknowns and the findings of a fit."""
    result = result_of(run_sysid(scene, list(overrides), out, threads=1))
    return result["unknowns"], result["findings"]


@pytest.mark.parametrize(("path", "true"), [(RATIO, 0.4), (DENSITY, 1100)])
def test_a_number_held_at_another_value_than_the_true_one(path, true, fit, tmp_path):
    """The modulus takes over the error, residuals hardly show it, and the finding says what would be right."""
    unknowns, told = findings(fit, tmp_path, f"data.synthetic.truth.{path}={true}")
    wrong, (low, high) = unknowns[E_PATH]["value"], unknowns[E_PATH]["interval"]
    assert not low <= 4.0e4 <= high
    (sentence,) = [text for text in told if f"{path} is held at" in text]
    about = float(re.search(f"With {true} the fit would find {E_PATH} about ([^ ]+) instead of", sentence)[1])
    assert abs(about - 4.0e4) < 0.25 * abs(wrong - 4.0e4)
    assert 0.5 < float(re.search("its residuals would be ([^ ]+) times as large", sentence)[1]) < 1.05


def test_what_an_interval_holds_fixed_is_in_the_result_and_the_report(fit, tmp_path):
    """Also what would move a value only within its interval; a fit with the other value finds it, to first order."""
    wrong = [f"data.synthetic.truth.{DENSITY}=1000.5", f"data.synthetic.truth.{RATIO}=0.32"]
    run = run_sysid(fit, wrong, tmp_path, threads=1)
    result = result_of(run)
    with_interval = [path for path, entry in result["unknowns"].items() if entry["interval"] is not None]
    assert with_interval == [E_PATH, SHEAR_PATH]
    here = result["unknowns"][E_PATH]["value"]
    for path, (value, other) in {DENSITY: (1000.0, 1100.0), RATIO: (0.3, 0.4)}.items():
        held = result["held"][path]
        assert (held["value"], held["other"]) == (value, pytest.approx(other))
        assert list(held["found"]) == with_interval
        again = result_of(run_sysid(fit, [*wrong, f"{path}={held['other']}"], tmp_path, threads=1))
        there = again["unknowns"][E_PATH]["value"]
        assert held["found"][E_PATH] - here == pytest.approx(there - here, rel=0.3)
    lines = report_lines(run)
    begin = lines.index("The intervals hold these numbers fixed. With the value under `if`, the fit would find about:")
    assert lines[begin + 1].split() == ["held", "fixed", "is", "if", "unknown", "would", "be"]
    rows = [line.split() for line in lines[begin + 2 : begin + 6]]
    found = result["held"][DENSITY]["found"]
    assert rows[0] == [DENSITY, "1000", "1100", E_PATH, f"{found[E_PATH]:.5g}", "outside", "its", "interval"]
    assert rows[1][:2] == [SHEAR_PATH, f"{found[SHEAR_PATH]:.5g}"]
    assert rows[2][:4] == [RATIO, "0.3", "0.4", E_PATH]


def test_numbers_with_which_the_data_were_made_are_right(fit, tmp_path):
    run = run_sysid(fit, [], tmp_path, threads=1)
    assert result_of(run)["findings"] == []
    assert "held" not in result_of(run)
    assert not any("hold these numbers fixed" in line for line in report_lines(run))


def test_an_unknown_that_ends_at_its_bound(fit, tmp_path):
    changed(fit, "bounds: [1.0e4, 1.0e5]", "bounds: [1.0e4, 3.5e4]")
    unknowns, told = findings(fit, tmp_path, f"data.synthetic.truth.{DENSITY}=1010")
    assert unknowns[E_PATH]["reason"] == "at its upper bound"
    assert told[0] == (
        f"{E_PATH} ended at its upper bound, 35000: the best fit lies there or beyond. Widen the bound if such a value "
        f"is possible; if not, another number is wrong, such as one that the scene holds fixed ({DENSITY} = 1000)"
    )


@pytest.mark.parametrize("frame", ["updated", "reference"])
def test_a_body_that_is_thin_on_the_grid_is_the_likely_cause_of_a_value_at_its_bound(frame, fit, tmp_path):
    """With synthetic data it is not, as they come from the same grid."""
    (file,) = record(fit, tmp_path / "data")
    scene = changed(recorded(fit, {"one": file}), "bounds: [1.0e4, 1.0e5]", "bounds: [1.0e4, 3.1e4]")
    _, told = findings(scene, tmp_path, f"world.frame={frame}", "time.substeps=24")
    assert told[0].startswith(f"{E_PATH} ended at its upper bound, 31000: the best fit lies there or beyond. ")
    damps = ", and the updated frame damps its motion" if frame == "updated" else ""
    assert told[0].endswith(
        ". A likely cause is the grid: 'beam' is 1 cell thick, and so bends too easily"
        f"{damps}; fit with a dx of 0.00333 m"
    )


def test_a_body_of_three_cells_is_no_cause(fit, tmp_path):
    (file,) = record(fit, tmp_path / "data")
    scene = load_scene(recorded(fit, {"one": file}), ["world.dx=0.00333", "time.substeps=auto"])
    case = SimpleNamespace(built=build(scene))
    assert _thin_on_the_grid(SimpleNamespace(cases=[case]), E_PATH) == ""


def test_an_unknown_that_does_nothing_stays_at_its_bound(fit, tmp_path):
    """Without gravity the beam rests, whatever its viscosity. L-BFGS stays at its start, which is a bound."""
    unknown = f"unknowns={{{SHEAR_PATH}: {{bounds: [3, 20]}}}}"
    _, told = findings(fit, tmp_path, "world.gravity=[0, 0]", unknown, "optimizer={lbfgs: {max_iterations: 3}}")
    assert told[0] == (
        f"{SHEAR_PATH} ended at its lower bound, 3, but the data do not depend on it there: fix it, or add data that do"
    )


def test_values_without_intervals(fit, tmp_path):
    """Forty numbers, some of them at a bound."""
    changed(fit, "scale: log}\n  bodies.beam.material.visc", "scale: log, per: particle}\n  bodies.beam.material.visc")
    _, told = findings(
        fit, tmp_path, "optimizer={lbfgs: {max_iterations: 3}}", f"data.synthetic.truth.{DENSITY}=1010",
        f"unknowns.{E_PATH}.bounds=[1.0e4, 3.1e4]",
    )  # fmt: skip
    assert re.match(rf"\d+ of 40 numbers of {E_PATH} ended at their upper bound, 31000: the best fit lies", told[0])
    assert told[1] == f"the scene holds {DENSITY} = 1000 fixed, and the identified values are right only if these are"


def test_an_objective_that_is_least_at_a_bound(fit, tmp_path):
    """It has no intervals, and no noise."""
    goal = "objective={up: {reach: {body: beam, position: [0.07, 0.09]}}}"
    _, told = findings(fit, tmp_path, "data=null", goal, "optimizer=null", "time.duration=0.05")
    assert f"{E_PATH} ended at its upper bound, 100000: the least objective lies there or beyond." in told[0]


def test_half_the_substep_is_run_in_the_updated_frame_alone():
    """The reference frame smooths nothing, and the check costs a rollout of twice the substeps."""

    def told(frame: str) -> list[str]:
        def halved() -> None:
            raise AssertionError("ran")

        scene = SimpleNamespace(world=SimpleNamespace(frame=frame), synthetic=None)
        case = SimpleNamespace(built=SimpleNamespace(scene=scene), points=())
        problem = SimpleNamespace(cases=[case], with_half_substep=halved)
        return list(of_the_substep(problem, np.zeros(1), np.ones((1, 1)), [], None))

    assert told("reference") == []
    with pytest.raises(AssertionError, match="ran"):
        told("updated")


def test_a_modulus_of_measured_data_in_2d_comes_with_that_of_a_narrow_beam(fit, tmp_path):
    (file,) = record(fit, tmp_path / "data")
    unknowns, told = findings(recorded(fit, {"one": file}), tmp_path)
    narrow = unknowns[E_PATH]["value"] / (1 - 0.3**2)
    assert told[-1].startswith(f"{E_PATH}: 2D is plane strain, so it is that of a body which is wide across the plane.")
    assert f"if its modulus is about {narrow:.4g} Pa" in told[-1]


@pytest.mark.parametrize("slow", [False, True])
def test_errors_that_are_no_noise_are_told(slow, rng):
    """White noise is not told, and neither is noise beside an error of half its square."""
    frames = np.arange(200)
    noise = rng.normal(size=(3, 200))
    wave = np.sin(frames / 15.0) * (3.0 if slow else 1.0)
    residuals = (noise + wave).ravel()
    series = [Series(200 * k + frames, frames, recording=0) for k in range(3)]
    case = SimpleNamespace(
        name="swing", comparisons=[None], built=SimpleNamespace(scene=SimpleNamespace(synthetic=None))
    )
    problem = SimpleNamespace(cases=[case], series=lambda: series)
    told = list(of_slow_errors(problem, residuals))
    assert len(told) == slow
    if slow:
        assert told[0].startswith("swing: 8")
        assert "of its squared error changes slowly from frame to frame, so it is not noise" in told[0]
    every_other = [Series(200 * k + frames, 2 * frames, recording=0) for k in range(3)]
    problem.series = lambda: every_other  # no two frames are neighbours: nothing is known
    assert list(of_slow_errors(problem, residuals)) == []
