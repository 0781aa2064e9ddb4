"""Poses: markers at rest under stated loads, fitted by equilibria; gradients, files, pictures, resume, bad input."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_arm import (
    ARM,
    LOWER,
    MARKERS,
    NOISE,
    NU,
    POSES,
    TRUE,
    UPPER,
    E,
    problem_of,
    recording,
    scene_of,
    write_poses,
)
from small_beam import Listener, assert_same, changed, result_of

import cqrun
from cqrun.build.load_path import gradient_of, inputs_of
from cqrun.build.matter import matter_of
from cqrun.build.model import build
from cqrun.engine.model import Inputs
from cqrun.errors import Stopped
from cqrun.figures.draw import draw_run
from cqrun.figures.run_data import read_run
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.resume import run_resume
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.jobs.validate import validate
from cqrun.measurements.markers import observe_markers
from cqrun.measurements.placement import PLACED, Placement
from cqrun.measurements.recording import Recording
from cqrun.optimizers.base import TrialFailed
from cqrun.scene.load import load_scene
from cqrun.store.formats.long_table import write_csv
from cqrun.store.trajectory import read_trajectory

OFFSET = (1.5e-3, -0.8e-3)
OFFSETS = [f"data.recordings.arm.offset.{k}" for k in range(2)]
NO_REST = r"recording 'arm': no equilibrium was found at point \d of 5, pose '[a-z ]+' \(actuators.*% of the way"
TURN = "data.recordings.arm.rotation.0"
TILT = "data.recordings.arm.overrides.world.gravity.0"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the poses in the long form, in the wide one in millimetres, and those of a shifted arm."""
    folder = tmp_path_factory.mktemp("poses")
    write_poses(folder / "poses.csv")
    write_poses(folder / "wide.csv", wide=True, unit="mm", seed=2)
    write_poses(folder / "shifted.csv", offset=OFFSET, overrides=["world.gravity=[0.9, -9.81]"], seed=3)
    return folder


@pytest.fixture
def folder(data: Path, tmp_path: Path) -> Path:
    """Return a folder of the test's own with the recordings."""
    for file in data.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


@pytest.fixture(scope="module")
def found(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished fit of both forms."""
    recordings = recording() + recording("wide", "wide.csv", holdout="true")
    return run_sysid(scene_of(data, recordings), [], tmp_path_factory.mktemp("found"), threads=1)


# --- what it finds ----------------------------------------------------------------------------------------------------


def test_the_modulus_is_found_with_an_interval(found):
    result = result_of(found)
    assert result["status"] == "converged"
    assert result.get("substeps") is None
    unknown = result["unknowns"][E]
    low, high = unknown["interval"]
    assert low < TRUE < high
    assert high - low < 0.01 * TRUE
    assert unknown["value"] == pytest.approx(TRUE, rel=1e-3)
    for name, holdout in (("arm", False), ("wide", True)):
        entry = result["recordings"][name]
        assert entry["holdout"] == holdout
        assert entry["rmse_mm"] == pytest.approx(1e3 * NOISE * np.sqrt(2), rel=0.5)
        assert set(entry["markers_mm"]) == set(MARKERS)
        assert list(entry["poses_mm"]) == list(POSES)
        assert entry["mean_mm"] == pytest.approx(np.mean(list(entry["poses_mm"].values())))


def test_table_trajectory_pictures_and_report(found):
    with (found / "poses.csv").open() as file:
        head, *rows = csv.reader(file)
    assert head == ["recording", "marker", "pose", "data_x", "data_y", "model_x", "model_y"]
    assert [row[2] for row in rows[: len(POSES)]] == list(POSES)
    entry = result_of(found)["recordings"]["arm"]
    of_arm = np.array([[float(number) for number in row[3:]] for row in rows if row[0] == "arm"])
    away = 1e3 * np.linalg.norm(of_arm[:, :2] - of_arm[:, 2:], axis=1)
    assert away.mean() == pytest.approx(entry["mean_mm"], rel=1e-9)
    assert np.sqrt((away**2).mean()) == pytest.approx(entry["rmse_mm"], rel=1e-9)

    frames = read_trajectory(found / "trajectory.h5").fields["x"]
    assert len(frames) == 1 + len(POSES)
    assert frames[1, :, 1].min() < frames[0, :, 1].min() - 0.01

    text = "\n".join(report_lines(found))
    assert (
        f"arm: mean marker error {entry['mean_mm']:.3f} mm; by pose: hanging {entry['poses_mm']['hanging']:.2f}" in text
    )
    assert "substeps" not in text
    drawn = {path.name for path in draw_run(found)}
    assert {"tracks_arm.png", "tracks_wide.png", "overview.png", "bodies.png", "convergence.png"} == drawn
    (tracks, _) = read_run(found).tracks()
    assert tracks.labels == tuple(POSES)
    assert tracks.at_rest


@pytest.mark.slow
def test_tilt_and_offset_of_one_recording_beside_a_shared_material(folder):
    unknowns = f"""\
  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}
  {TILT}: {{bounds: [-3, 3]}}
  {OFFSETS[0]}: {{bounds: [-0.01, 0.01]}}
  {OFFSETS[1]}: {{bounds: [-0.01, 0.01]}}
"""
    recordings = recording("arm", "shifted.csv") + recording("straight")
    result = result_of(run_sysid(scene_of(folder, recordings, unknowns), [], folder / "out", threads=1))
    for path, truth in zip((E, TILT, *OFFSETS), (TRUE, 0.9, *OFFSET), strict=True):
        low, high = result["unknowns"][path]["interval"]
        assert low < truth < high, path
    assert result["recordings"]["arm"]["rmse_mm"] < 0.06


@pytest.mark.slow
def test_markers_in_motion_and_poses_in_one_fit(folder):
    """Both are in metres and share the modulus; the motion is a swing in the reference frame."""
    swing = ARM.replace("duration: 0.02", "duration: 0.1")
    (folder / "swing.yaml").write_text(swing)
    problem = cqrun.load(folder / "swing.yaml", [f"{E}={TRUE}"], threads=1)
    motion = problem.simulate()
    observer = observe_markers(matter_of(problem.built, {}), "arm", {"tip": np.array(MARKERS["tip"])})
    places = np.einsum("mn,tnd->tmd", observer.rows.toarray(), motion.x)
    write_csv(Recording(motion.time, ("tip",), places, "swing"), folder / "swing.csv")
    text = scene_of(
        folder, recording() + f"    swing: {{file: swing.csv, length: 0.09, markers: {{tip: {MARKERS['tip']}}}}}\n"
    )
    text.write_text(text.read_text().replace("duration: 0.02", "duration: 0.1"))
    fit = problem_of(text)
    x = fit.start
    value, gradient = fit.value_and_grad(x)
    r = fit.residuals(x)
    assert value == pytest.approx(0.5 * r @ r, rel=1e-9)
    h = 1e-4
    assert gradient[0] == pytest.approx((fit.value(x + h) - fit.value(x - h)) / (2 * h), rel=1e-5)
    result = result_of(run_sysid(text, [], folder / "out", threads=1))
    assert result["unknowns"][E]["value"] == pytest.approx(TRUE, rel=2e-3)
    assert result["substeps"] > 0
    assert set(result["recordings"]) == {"arm", "swing"}
    assert {path.name for path in (folder / "out").glob("*/*/*.csv")} == {"history.csv", "poses.csv", "tracks.csv"}


def test_poses_are_predicted_without_a_fit(folder):
    run = run_sysid(scene_of(folder, recording(holdout="true")), [f"{E}={TRUE}"], folder / "out", threads=1)
    result = result_of(run)
    assert result["message"].startswith("nothing was fitted")
    assert result["recordings"]["arm"]["rmse_mm"] < 0.06
    assert any("mean marker error" in line for line in report_lines(run))


# --- gradients --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("point", [{UPPER: 30.0}, {"activation.upper": 0.4}, {"activation.lower": 0.0, E: 9e4}])
def test_the_adjoint_of_a_points_inputs(point, rng):
    """What a point sets no longer depends on the values; all else does, exactly as the inputs do."""
    built = build(load_scene(ARM, [f"{UPPER}=20", f"{LOWER}=10"]))
    values = {
        E: np.array(1.3e5),
        UPPER: np.array(20.0),
        LOWER: np.array(11.0),
        "activation.signals.upper.0": np.array(0.7),
    }
    inputs = inputs_of(built, point, values)
    bar = Inputs.zeros_like(inputs)
    bar.activation[:] = rng.normal(size=bar.activation.shape)
    bar.strength[:] = rng.normal(size=bar.strength.shape)
    bar.terms = [[rng.normal(size=theta.shape) / np.abs(theta).max() for theta in group] for group in inputs.terms]
    gradient = gradient_of(built, point, values, bar)

    def at(path: str, h: float) -> float:
        i = inputs_of(built, point, values | {path: values[path] + h})
        total = (i.activation * bar.activation).sum() + (i.strength * bar.strength).sum()
        return float(total + sum((a * b).sum() for g, w in zip(i.terms, bar.terms, strict=True)
                                 for a, b in zip(g, w, strict=True)))  # fmt: skip

    for path, value in values.items():
        h = 1e-3 * float(value)
        assert gradient[path] == pytest.approx((at(path, h) - at(path, -h)) / (2 * h), rel=1e-8, abs=1e-9), path
        if path in point:
            assert gradient[path] == 0.0


def test_the_loss_has_the_adjoint_of_a_dot_product(folder, rng):
    (case,) = problem_of(scene_of(folder, recording())).cases
    (poses,) = case.comparisons
    records = case.run({E: np.array(1.2e5)})
    bar, _ = poses.loss_vjp(records, 0.0, 1.7)
    parts = ("x", "F")
    change = {name: 1e-3 * rng.normal(size=getattr(records, name).shape) for name in parts}

    def loss(h: float) -> float:
        moved = records.zeros_like()
        moved.add(records)
        for name, part in change.items():
            getattr(moved, name)[...] += h * part
        return 1.7 * poses.loss(moved, 0.0)

    along = sum(float((getattr(bar, name) * part).sum()) for name, part in change.items())
    h = 1e-3
    assert along == pytest.approx((loss(-2 * h) - 8 * loss(-h) + 8 * loss(h) - loss(2 * h)) / (12 * h), rel=1e-9)
    here = Placement(np.array([0.01, -0.02]), np.array([0.3]))
    placed_bar = here.vjp(*poses.placed(here).measured_vjp(records, 0.0, 1.7))
    for what in PLACED:
        for k, slope in enumerate(getattr(placed_bar, what)):
            step = 1e-3 * np.eye(len(getattr(here, what)))[k]
            ends = (replace(here, **{what: getattr(here, what) + n * step}) for n in (-2, -1, 1, 2))
            far, near, ahead, beyond = (1.7 * poses.placed(end).loss(records, 0.0) for end in ends)
            assert slope == pytest.approx((far - 8 * near + 8 * ahead - beyond) / 12e-3, rel=1e-9)


def test_taylor_through_the_equilibria(folder):
    unknowns = f"  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}\n  {NU}: {{bounds: [0.1, 0.45]}}\n"
    problem = problem_of(scene_of(folder, recording(), unknowns))
    x, d = problem.start + 0.013, np.array([1.0, -0.3])
    value, gradient = problem.value_and_grad(x)
    steps = 1e-2 * 0.5 ** np.arange(4)
    left = [abs(problem.value(x + h * d) - value - h * float(gradient @ d)) for h in steps]
    assert np.diff(np.log(left)).max() / np.log(0.5) > 1.9


@pytest.mark.slow
def test_gradcheck_agrees(folder):
    unknowns = f"""\
  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}
  {TILT}: {{bounds: [-3, 3]}}
  {OFFSETS[0]}: {{bounds: [-0.01, 0.01]}}
  data.recordings.arm.rotation.0: {{bounds: [-0.3, 0.3]}}
"""
    run, agrees = run_gradcheck(scene_of(folder, recording(), unknowns), [], folder / "out", threads=1)
    assert agrees, "\n".join(report_lines(run))


def test_python_gives_the_gradient_by_any_number(folder):
    experiment = cqrun.load(scene_of(folder, recording()), threads=1)
    paths = {E: 1.2e5, NU: 0.33, "bodies.arm.material.density": 1030.0}
    loss, gradient, aux = experiment.value_and_grad(paths)
    assert aux["losses"]["arm"] == pytest.approx(loss)
    for path, value in paths.items():
        h = 1e-4 * value
        ends = [experiment.value_and_grad(paths | {path: value + k * h})[0] for k in (-1.0, 1.0)]
        assert gradient[path] == pytest.approx((ends[1] - ends[0]) / (2 * h), rel=1e-5)


# --- runs -------------------------------------------------------------------------------------------------------------


SLOW_FIT = pytest.param("least_squares: {max_iterations: 15}", marks=pytest.mark.slow)


@pytest.mark.parametrize("optimizer", [SLOW_FIT, "lbfgs: {max_iterations: 4}"])
def test_stopped_and_resumed_it_is_the_same_to_the_bit(folder, optimizer):
    scene = changed(scene_of(folder, recording()), "least_squares: {max_iterations: 15}", optimizer)
    whole = run_sysid(scene, [], folder / "whole", threads=1)
    with pytest.raises(Stopped):
        run_sysid(scene, [], folder / "stopped", threads=1, reporter=Listener(stop_after=2))
    (run,) = (folder / "stopped").glob("*/*")
    assert result_of(run)["status"] == "stopped"
    run_resume(run, [], threads=1)
    assert_same(run, whole)


def test_residuals_do_not_depend_on_what_was_evaluated_before(folder):
    """Equilibria start from others, but never from those of another trial: else a resumed fit would differ."""
    scene = scene_of(folder, recording())
    problem, fresh = problem_of(scene), problem_of(scene)
    x = problem.start + 0.1
    problem.residuals_and_jacobian(problem.start)
    problem.residuals(problem.start + 0.2)
    assert np.array_equal(problem.residuals(x), fresh.residuals(x))
    assert np.array_equal(problem.residuals(problem.start), problem_of(scene).residuals(problem.start))
    assert problem.value(x) == problem_of(scene).value(x)


def test_a_difference_starts_from_the_equilibria_beside_it(folder):
    """It takes a few steps where a start from the rest shape takes many, and ends in the same place."""
    scene = scene_of(folder, recording())
    (case,) = problem_of(scene).cases
    values = {E: np.array(2.0e5)}
    near = case.run(values)
    moved = {E: np.array(2.001e5)}
    path, alone = case.runner.path(moved, near=near), case.runner.path(moved)
    records, records_alone = path.run(), alone.run()
    np.testing.assert_allclose(records.x, records_alone.x, rtol=0, atol=1e-9)
    assert max(point.rest.steps for point in path.points) <= 5 < max(point.rest.steps for point in alone.points)


def test_validate_says_what_is_compared(folder):
    lines = list(validate(scene_of(folder, recording(offset="[0.001, 0]"))))
    said = (
        f"arm (fitted): 2 markers in 5 equilibria; upper_N is {UPPER}, 0 to 150; lower_N is {LOWER}, 0 to 80; push_N is"
    )
    assert any(f"recording  {said}" in line for line in lines)
    assert any("given for this recording alone: offset" in line for line in lines)


def test_values_without_an_equilibrium_are_a_failed_trial(folder):
    """Newton's method cannot reach an arm that is a thousand times too soft."""
    unknowns = f"  {E}: {{bounds: [1.0, 4.0e5], scale: log}}\n"
    problem = problem_of(scene_of(folder, recording(), unknowns))
    with pytest.raises(TrialFailed, match=NO_REST), np.errstate(all="ignore"):
        problem.value(np.array([0.0]))


@pytest.mark.parametrize("mirrored", ["up more", "down"])
def test_a_pose_that_ends_elsewhere_than_the_data_is_a_finding(mirrored, folder):
    """The arm of the recording had snapped to the other side in one pose, or its load has another sign."""
    text = (folder / "poses.csv").read_text().splitlines()
    for k, line in enumerate(text):
        pose, *loads, marker, x, y = line.split(",")
        if pose == mirrored and marker == "tip":
            text[k] = ",".join([pose, *loads, marker, x, str(2 * 0.06 - float(y))])
    (folder / "poses.csv").write_text("\n".join(text))
    run = run_sysid(scene_of(folder, recording(holdout="true")), [f"{E}={TRUE}"], folder / "runs", threads=1)
    (finding,) = [each for each in result_of(run)["findings"] if "from where it was seen" in each]
    assert finding.startswith(f"arm: pose '{mirrored}' ends ")
    assert "the body may rest in several places under these loads" in finding


def test_poses_near_the_data_are_not(found):
    assert not any("from where it was seen" in each for each in result_of(found)["findings"])


def test_a_whole_axis_and_single_cells_may_be_missing(folder):
    """Only heights were measured, and the stem was hidden in one pose."""
    with (folder / "wide.csv").open() as file:
        head, *rows = csv.reader(file)
    kept = [k for k, name in enumerate(head) if not name.endswith("_x_mm")]
    rows[1][head.index("stem_y_mm")] = ""
    lines = [head, *rows]
    (folder / "heights.csv").write_text("\n".join(",".join(row[k] for k in kept) for row in lines) + "\n")
    problem = problem_of(scene_of(folder, recording(file="heights.csv")))
    assert problem.residuals(problem.start).shape == (2 * len(POSES) - 1,)
    result = result_of(run_sysid(folder / "arm.yaml", [], folder / "out", threads=1))
    assert result["unknowns"][E]["value"] == pytest.approx(TRUE, rel=3e-3)
