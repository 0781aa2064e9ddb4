"""`cqrun sysid` where every recording is held out: it predicts, says so, and fits nothing."""

from __future__ import annotations

import csv
import math

import pytest
from small_beam import BEAM, E_PATH, SHEAR_PATH, Listener, record, recorded, result_of

import cqrun
from cqrun.cli.results import draw_and_print_run
from cqrun.errors import RunError, SceneError, UsageError
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.jobs.validate import validate
from cqrun.scene.load import load_scene
from cqrun.store.run import read_record

NOTHING = "nothing was fitted, because every recording is held out"
TRUE = (f"{E_PATH}=4.0e4", f"{SHEAR_PATH}=6")


@pytest.fixture
def held_out(fit, tmp_path):
    """Return a scene without unknowns, and with two recordings that are held out."""
    files = dict(zip(("one", "two"), record(fit, tmp_path / "data", copies=2), strict=True))
    recorded(fit, files, holdout="true")
    text = fit.read_text()
    fit.write_text(text[: text.index("unknowns:")])
    return fit


def test_it_predicts_and_says_that_nothing_was_fitted(held_out, tmp_path):
    listener = Listener()
    run = run_sysid(held_out, TRUE, tmp_path, threads=1, reporter=listener)
    result = result_of(run)
    assert (result["status"], result["message"]) == ("done", NOTHING)
    assert (result["unknowns"], result["loss"], result["iterations"]) == ({}, None, 0)
    noise = 1e3 * 2.0e-5 * math.sqrt(2.0)
    for name in ("one", "two"):
        assert result["recordings"][name]["holdout"]
        assert result["recordings"][name]["rmse_mm"] == pytest.approx(noise, rel=0.4)
    assert any(
        "every recording is held out: predicting 2 recordings, fitting nothing" in said for said in listener.said
    )
    assert not (run / "history.csv").exists()
    with (run / "tracks.csv").open() as file:
        assert {row["recording"] for row in csv.DictReader(file)} == {"one", "two"}
    lines = report_lines(run)
    assert lines[0] == f"done: {NOTHING}"
    assert "predicted with time.substeps=24" in lines
    assert any(line.startswith("two        held out  0.0") for line in lines)
    assert "see tracks.csv, trajectory.h5" in lines


def test_other_values_predict_worse(held_out, tmp_path):
    right, wrong = (result_of(run_sysid(held_out, values, tmp_path, threads=1)) for values in (TRUE, ()))
    assert wrong["recordings"]["one"]["rmse_mm"] > 10.0 * right["recordings"]["one"]["rmse_mm"]


@pytest.mark.usefixtures("pictures")
def test_its_pictures(held_out, tmp_path):
    run = run_sysid(held_out, TRUE, tmp_path, threads=1)
    draw_and_print_run(run, quiet=True, allow_plugins=False)
    drawn = {file.name for file in (run / "figures").iterdir()}
    assert drawn == {"bodies.png", "overview.png", "tracks_one.png", "tracks_two.png"}


def test_unknowns_keep_the_values_that_they_start_from(fit, tmp_path):
    (file,) = record(fit, tmp_path / "data")
    recorded(fit, {"one": file}, holdout="true")
    values = (f"unknowns.{E_PATH}.initial=4.0e4", f"{SHEAR_PATH}=6")
    result = result_of(run := run_sysid(fit, values, tmp_path, threads=1))
    for path, value in ((E_PATH, 4.0e4), (SHEAR_PATH, 6.0)):
        assert result["unknowns"][path] == {"initial": value, "value": value, "interval": None, "reason": NOTHING}
    assert result["recordings"]["one"]["rmse_mm"] < 0.04
    assert f"no intervals: {NOTHING}" in report_lines(run)
    replay = run_simulate(run, [], tmp_path, threads=1)
    assert "youngs_modulus: 40000.0" in (replay / "scene.yaml").read_text()


def test_it_has_a_run_that_is_finished_and_can_be_resumed(held_out, tmp_path):
    run = run_sysid(held_out, TRUE, tmp_path, threads=1)
    before = (run / "result.json").read_bytes()
    listener = Listener()
    assert run_sysid(held_out, TRUE, tmp_path, threads=1, reporter=listener) == run
    assert listener.said == ["finished already (done); --fresh starts over"]
    assert run_resume(run, [], threads=1) == run
    assert (run / "result.json").read_bytes() == before
    with pytest.raises(UsageError, match="nothing is fitted, so it has no iterations: every recording is held out"):
        run_resume(run, ["optimizer.lbfgs.max_iterations=3"], threads=1)


def test_validate_says_it_before_the_run(held_out, fit):
    told = "\n".join(validate(held_out, ["job=sysid"]))
    assert "fit        none: every recording is held out, so sysid predicts them with the scene's values\n" in told
    assert "one (held out): 2 markers" in told
    assert "optimizer" not in told
    assert "fit        none: every recording is held out" in "\n".join(validate(held_out))


def test_one_that_blows_up_does_not_hide_the_other(held_out, tmp_path):
    mad = "data.recordings.one.overrides={world.gravity: [5000, 0]}"
    run = run_sysid(held_out, [mad], tmp_path, threads=1)
    result = result_of(run)
    assert result["recordings"]["one"]["rmse_mm"] is None
    assert result["recordings"]["two"]["rmse_mm"] > 0
    assert any("one: held out, and it blows up with the scene's values: body" in text for text in result["findings"])
    assert any(line.startswith("one        held out  blew up") for line in report_lines(run))
    assert (run / "trajectory.h5").exists()


def test_all_that_blow_up_fail_the_run(held_out, tmp_path):
    with pytest.raises(RunError, match="no recording can be predicted: one: held out, and it blows up"):
        run_sysid(held_out, ["world.gravity=[5000, 0]"], tmp_path, threads=1)
    (record_file,) = tmp_path.glob("fit/*/run.json")
    assert read_record(record_file.parent)["status"] == "failed"
    assert report_lines(record_file.parent)[0].startswith("failed: no recording can be predicted")


def test_a_fit_without_unknowns_says_how_to_predict(held_out, tmp_path):
    with pytest.raises(SceneError, match=r"sysid needs it: .* to predict only, mark every recording `holdout: true`"):
        run_sysid(held_out, ["data.recordings.one.holdout=false"], tmp_path, threads=1)


def test_there_is_no_loss_to_differentiate(held_out, tmp_path):
    with pytest.raises(UsageError, match="every recording is held out, so there is no loss: fit one of them, or use"):
        cqrun.load(held_out).value_and_grad()
    run, agrees = run_gradcheck(held_out, ["time.duration=0.02"], tmp_path, threads=1)
    assert agrees
    assert report_lines(run)[0].startswith("gradient of a random function of the final state")


def test_what_a_prediction_cannot_have(held_out, tmp_path):
    assert load_scene(held_out).predicts_only
    assert not load_scene(BEAM).predicts_only
    with pytest.raises(SceneError, match=r"constraints.light: sysid does not support constraints"):
        run_sysid(held_out, ["constraints={light: {of: {mass: {body: beam}}, at_most: 1}}"], tmp_path, threads=1)
