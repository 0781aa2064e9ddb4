"""`cqrun gradcheck`: it finds a right gradient right and a wrong one wrong, for every kind of scene."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_beam import E_PATH, SHEAR_PATH, Listener, changed, record, recorded

from cqrun.design.params import Params
from cqrun.errors import RunError, SceneError, Stopped, UsageError
from cqrun.jobs.gradcheck import ALL, SUMMARY, run_gradcheck
from cqrun.jobs.resume import run_resume
from cqrun.jobs.table import report_lines
from cqrun.running import finite_differences
from cqrun.running.finite_differences import STEPS, TOO_ROUGH
from cqrun.store.run import read_record


def check(scene, out, *overrides, reporter=None, threads=1):
    run, agrees = run_gradcheck(scene, overrides, out, threads=threads, reporter=reporter)
    return run, agrees, json.loads((run / "gradcheck.json").read_text())


def test_the_fits_gradient(fit, tmp_path):
    run, agrees, found = check(fit, tmp_path)
    assert agrees
    assert found["agrees"]
    assert [row["block"] for row in found["rows"]] == [E_PATH, SHEAR_PATH, ALL]
    for row in found["rows"]:
        assert row["error"] < 1e-7  # far below the tolerance: the plateau is found
        assert len(row["scan"]) == len(found["steps"]) == len(STEPS) - 1
    lines = report_lines(run)
    assert lines[0].startswith("gradient of the fit's loss, in units of ")
    assert lines[-1] == "adjoint and differences agree"
    assert (read_record(run)["job"], read_record(run)["status"]) == ("gradcheck", "done")
    listener = Listener()
    assert run_gradcheck(fit, [], tmp_path, threads=1, reporter=listener) == (run, True)
    assert listener.said == ["finished already (done); --fresh starts over"]


def test_a_scene_without_data_is_checked_by_all_its_numbers(beam, tmp_path):
    _, agrees, found = check(beam, tmp_path)
    assert agrees
    assert [row["block"] for row in found["rows"]] == [
        "world.gravity", "bodies.beam.shape.box.corner", "bodies.beam.shape.box.size", "bodies.beam.velocity",
        "bodies.beam.spin", "bodies.beam.material.density", E_PATH,
        E_PATH.replace("youngs_modulus", "poissons_ratio"), SHEAR_PATH, "bodies.beam.material.viscosity.bulk", ALL,
    ]  # fmt: skip
    assert [row["count"] for row in found["rows"]] == [2, 2, 2, 2, 1, 1, 1, 1, 1, 1, 14]
    assert max(row["error"] for row in found["rows"]) < 1e-6


@pytest.mark.parametrize(("per", "count"), [("particle", 40), ("group", 1)])
def test_a_value_a_particle_or_a_group(fit, tmp_path, per, count):
    changed(fit, "scale: log}\n  bodies.beam.material.visc", f"scale: log, per: {per}}}\n  bodies.beam.material.visc")
    _, agrees, found = check(fit, tmp_path)
    assert agrees
    assert [row["count"] for row in found["rows"]] == [count, 1, count + 1]
    assert max(row["error"] for row in found["rows"]) < 1e-6


def test_a_wrong_gradient_is_found(fit, tmp_path, monkeypatch):
    right = Params.gradient

    def wrong(self, x, by_value):
        return right(self, x, by_value) * np.array([1.0, 1.0 + 3e-5])

    monkeypatch.setattr(Params, "gradient", wrong)
    run, agrees, found = check(fit, tmp_path)
    assert not agrees
    assert [row["agrees"] for row in found["rows"]][:2] == [True, False]
    lines = report_lines(run)
    assert lines[3].endswith("DISAGREES")
    assert lines[-1] == "adjoint and differences DISAGREE"
    assert run_gradcheck(fit, [], tmp_path, threads=1) == (run, False)  # and it is remembered
    with pytest.raises(RunError, match="adjoint and differences disagree"):
        run_resume(run, [], threads=1)


def test_what_does_nothing_is_flat_and_agrees(fit, tmp_path):
    """Without gravity the beam rests, whatever its viscosity."""
    changed(fit, "gravity: [0, -9.81]", "gravity: [0, 0]")
    run, agrees, found = check(fit, tmp_path)
    assert agrees
    assert found["rows"][1]["adjoint"] == 0.0
    assert all(line.endswith("flat: nothing to compare") for line in report_lines(run)[2:-1])


def test_an_unknown_at_its_bound_is_checked_inside(fit, tmp_path):
    changed(fit, "bounds: [0.5, 20]", "bounds: [3, 20]")
    _, agrees, found = check(fit, tmp_path)
    assert agrees
    assert "a little inside the bounds" in found["of"]


def test_a_stopped_check_starts_again(fit, tmp_path):
    with pytest.raises(Stopped, match="stopped before its results were written"):
        check(fit, tmp_path, reporter=Listener(stop_after=1))
    (run,) = (tmp_path / "fit").iterdir()
    assert report_lines(run) == ["gradcheck: stopped (stopped before its results were written)"]
    assert run_resume(run, [], threads=1) == run
    assert report_lines(run)[-1] == "adjoint and differences agree"


def test_a_stopped_check_does_not_go_on_with_other_recordings(fit, tmp_path):
    (file,) = record(fit, tmp_path / "data", copies=1)
    scene = recorded(fit, {"one": file})
    with pytest.raises(Stopped):
        check(scene, tmp_path / "out", reporter=Listener(stop_after=1))
    (run,) = (tmp_path / "out").glob("*/*")
    text = file.read_text()
    file.write_text(text.rstrip().rpartition("\n")[0] + "\n")
    with pytest.raises(UsageError, match="a recording that it names has changed"):
        run_resume(run, [], threads=1)
    file.write_text(text)
    run_resume(run, [], threads=1)


def test_a_start_that_blows_up_is_told(beam, tmp_path):
    changed(beam, "[0, -9.81]", "[1000, 0]")
    with pytest.raises(RunError, match=r"with the start values: body 'beam', .* left the grid"):
        check(beam, tmp_path)
    (run,) = (tmp_path / "beam").iterdir()
    assert read_record(run)["status"] == "failed"


def test_too_little_memory_is_refused_before_there_is_a_run(fit, tmp_path):
    with pytest.raises(SceneError, match=r"-o memory=2KiB: memory: a gradient needs 10 states of .*; the budget is"):
        check(fit, tmp_path, "memory=2KiB")
    assert not (tmp_path / "fit").exists()


def test_a_direction_whose_steps_all_fail_disagrees(fit, tmp_path, monkeypatch):
    monkeypatch.setattr(finite_differences, "_central", lambda loss, d, h: float("nan"))
    run, agrees, found = check(fit, tmp_path)
    assert not agrees
    assert found["rows"][0]["scan"] == [None] * (len(STEPS) - 1)
    assert report_lines(run)[2].endswith("every step's rollout failed: DISAGREES")


def test_differences_that_are_too_rough_do_not_agree(fit, tmp_path, monkeypatch):
    """They scatter by more than they are, at every step: no adjoint could be told right by them, or wrong."""
    monkeypatch.setattr(
        finite_differences, "_central", lambda loss, d, h: (-1.0) ** round(float(np.log(h) / np.log(4.0)))
    )
    run, agrees, found = check(fit, tmp_path)
    assert not agrees
    assert {row["verdict"] for row in found["rows"]} == {TOO_ROUGH}
    assert len(found["steps"]) > len(STEPS) - 1
    lines = report_lines(run)
    assert all(line.endswith("TOO ROUGH TO TELL") for line in lines[2:-1])
    assert lines[-1] == read_record(run)["reason"] == SUMMARY[TOO_ROUGH]
    with pytest.raises(RunError, match="too rough to tell whether the adjoint is right"):
        run_resume(run, [], threads=1)
