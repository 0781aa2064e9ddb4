"""The commands from end to end: what they print, and their exit codes."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_beam import BEAM, E_PATH, FIT

from cqrun.design.params import Params


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Return a scene in an empty working directory."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fit.yaml").write_text(BEAM + FIT)
    return "fit.yaml"


def test_sysid_prints_its_results_and_the_run(cqrun, scene, tmp_path):
    code, out, err = cqrun("sysid", scene, "--threads", 1)
    assert code == 0, err
    lines = out.splitlines()
    assert lines[0].startswith("converged after ")
    assert any(line.startswith(E_PATH) for line in lines)
    (run,) = (tmp_path / "results" / "fit").iterdir()
    assert lines[-1] == f"run: {run.relative_to(tmp_path)}"
    assert "fitting 2 unknowns" in err
    assert "iteration 1/8  loss " in err
    code, again, err = cqrun("sysid", scene, "--quiet")
    assert (code, again) == (0, out)
    (thin,) = err.splitlines()
    assert thin.startswith("warning: fit.yaml:7:5: bodies.beam.shape: is 1 cell thick")


def test_simulate_prints_the_positions_of_the_bodies(cqrun, scene):
    code, out, err = cqrun("simulate", scene, "--threads", 2, "-o", "time.duration=0.02")
    assert code == 0, err
    assert out.startswith("done: 0.02 s simulated\n")
    assert "simulating 40 particles, 48 substeps" in err
    assert "t = 0 of 0.02 s" in err


def test_a_run_is_found_again_from_any_folder(cqrun, scene, tmp_path, monkeypatch):
    short = ("-o", "time.duration=0.02", "-q")
    code, _, err = cqrun("simulate", scene, *short)
    assert code == 0, err
    (run,) = (tmp_path / "results" / "fit").iterdir()
    written = (run / "result.json").stat().st_mtime_ns
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    code, again, err = cqrun("simulate", "../fit.yaml", *short)
    assert code == 0, err
    assert again.splitlines()[-1] == f"run: {Path('../results/fit') / run.name}"
    assert (run / "result.json").stat().st_mtime_ns == written
    assert list(elsewhere.iterdir()) == []
    code, _, err = cqrun("simulate", "../fit.yaml", *short, "--out", "here")
    assert code == 0, err
    assert (elsewhere / "here" / "fit" / run.name / "result.json").is_file()


@pytest.mark.usefixtures("pictures")
def test_an_error_while_drawing_does_not_make_the_run_fail(cqrun, scene, monkeypatch):
    def broken(run):
        raise ValueError("no such axis")

    monkeypatch.setattr("cqrun.figures.draw.draw_run", broken)
    code, out, err = cqrun("simulate", scene, "--quiet", "-o", "time.duration=0.02")
    assert (code, out.splitlines()[-1].partition(" ")[0]) == (0, "run:")
    assert err.splitlines()[-1].startswith("warning: no pictures: ValueError: no such axis; `cqrun plot results")


def test_pictures_can_be_switched_off(cqrun, scene, monkeypatch, tmp_path):
    """For example for the hundreds of runs of a comparison."""
    monkeypatch.setenv("CQRUN_PICTURES", "0")
    assert cqrun("simulate", scene, "--quiet", "-o", "time.duration=0.02")[0] == 0
    assert not list((tmp_path / "results").rglob("*.png"))
    monkeypatch.setenv("CQRUN_PICTURES", "1")
    assert cqrun("simulate", scene, "--quiet", "-o", "time.duration=0.02")[0] == 0
    assert list((tmp_path / "results").rglob("*.png"))


def test_gradcheck_ends_with_0_or_1(cqrun, scene, monkeypatch):
    code, out, _ = cqrun("gradcheck", scene, "--quiet")
    assert code == 0
    assert "adjoint and differences agree\n\nsee report.html\nrun: results/fit/" in out
    right = Params.gradient
    monkeypatch.setattr(Params, "gradient", lambda self, x, by_value: 1.001 * right(self, x, by_value))
    code, out, _ = cqrun("gradcheck", scene, "--quiet", "--fresh")
    assert code == 1
    assert "adjoint and differences DISAGREE" in out


def test_output_of_validate_and_warmup(cqrun, scene):
    code, out, err = cqrun("validate", scene)
    assert (code, err) == (0, "")
    assert out.startswith("fit.yaml: a valid scene: a small cantilever\n")
    code, out, _ = cqrun("warmup", scene, "--quiet")
    assert code == 0
    assert out.endswith(" s  2D float64, fixed_corotated + viscosity, sticky, forward and backward\n")


def test_a_failed_run_ends_with_1_and_a_reason(cqrun, scene):
    code, out, err = cqrun("simulate", scene, "-o", "world.gravity=[1000, 0]", "-q")
    assert (code, out) == (1, "")
    stiffness, thickness, error = err.splitlines()  # too soft for such a gravity, and thin
    assert stiffness.startswith("warning: fit.yaml:")
    assert thickness.startswith("warning: fit.yaml:")
    assert error.startswith("error: results/fit/")
    assert "body 'beam', particle " in error
    assert "left the grid" in error
