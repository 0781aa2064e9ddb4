"""Forces and moments of boundaries as data: what is found, gradients, signs, units, bad input."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from small_arm import ARM, LOWER, UPPER, E, recording, rested, write_poses
from small_beam import changed, result_of

from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.figures.draw import draw_run
from cqrun.figures.run_data import read_run
from cqrun.fitting.cases import given_cases
from cqrun.fitting.problem import FitProblem
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.jobs.validate import validate
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene

PROPPED = ARM.replace(
    "loads:\n", "  prop: {slip: {region: {box: {corner: [0.13, 0], size: [0.07, 0.12]}}, normal: [0, 1]}}\nloads:\n"
)
"""The arm with its far end on a prop, which holds its height."""

DENSITY, TRUE, NOISE = "bodies.arm.material.density", 1200.0, 2e-3
"""What is weighed [kg/m^3], its value in the data, and the noise of the load cell [N/m]."""

PULLS = (0.0, 20.0, 40.0, 60.0, 80.0, 100.0, 120.0, 140.0)
"""Tension of the upper cable [N/m]; the lower one has 10."""

LOADS = f"loads: {{pull_N: {UPPER}}}"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what the prop and the clamp do to the arm, and with the arm's poses."""
    folder = tmp_path_factory.mktemp("forces")
    points = [{UPPER: pull, LOWER: 10.0} for pull in PULLS]
    _, records, _ = rested([f"{DENSITY}={TRUE}", f"{LOWER}=10"], points, PROPPED)
    rng = np.random.default_rng(5)
    prop, moment = (records.held[name][1:, k] for name, k in (("prop", 1), ("clamp", 2)))
    prop, moment = prop + NOISE * rng.normal(size=len(prop)), moment + 1e-4 * rng.normal(size=len(prop))
    tables = {
        "prop.csv": (["pull_N", "force_N"], [PULLS, prop]),
        "cell.csv": (["pull_N", "cell_mN", "note"], [PULLS, -1e3 * (prop - prop[0]), np.arange(8)]),
        "clamp.csv": (["pull_N", "moment_Nmm"], [PULLS, 1e3 * moment]),
    }
    for name, (head, columns) in tables.items():
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows([head, *np.array(columns).T.tolist()])
    write_poses(folder / "poses.csv", overrides=[f"{DENSITY}={TRUE}"])
    return folder


@pytest.fixture
def folder(data: Path, tmp_path: Path) -> Path:
    """Return a folder of the test's own with the recordings."""
    for file in data.glob("*.csv"):
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path


PROP = f"    prop: {{file: prop.csv, force: {{boundary: prop, component: y, column: force_N, {LOADS}}}}}\n"
CELL = (
    "    cell: {file: cell.csv, force: {boundary: prop, component: y, column: cell_mN, on: boundary, from_first: true, "
    f"ignore: [note], {LOADS}}}}}\n"
)
CLAMP = f"    clamp: {{file: clamp.csv, moment: {{boundary: clamp, column: moment_Nmm, {LOADS}}}}}\n"


def scene_of(folder: Path, recordings: str, unknowns: str = "", scene: str = PROPPED) -> Path:
    """Write a scene that is fitted to recordings."""
    file, unknowns = folder / "propped.yaml", unknowns or f"  {DENSITY}: {{bounds: [500, 3000]}}\n"
    file.write_text(
        f"{scene}data:\n  recordings:\n{recordings}unknowns:\n{unknowns}".replace(
            "spacing: 0.01, tension: 0}}\nactivation", "spacing: 0.01, tension: 10}}\nactivation"
        )
        + "optimizer: {least_squares: {max_iterations: 10}}\n"
    )
    return file


def problem_of(scene: Path, *overrides: str) -> FitProblem:
    built = build(load_scene(scene, overrides))
    cases = given_cases(built)
    assert cases is not None
    return FitProblem(cases, make_params(built))


# --- what it finds ----------------------------------------------------------------------------------------------------


def test_a_prop_weighs_an_arm(folder):
    run = run_sysid(scene_of(folder, PROP + CLAMP), [], folder / "out", threads=1)
    result = result_of(run)
    low, high = result["unknowns"][DENSITY]["interval"]
    assert low < TRUE < high
    assert result["unknowns"][DENSITY]["value"] == pytest.approx(TRUE, rel=2e-3)
    entries = result["recordings"]
    assert entries["prop"] == {
        "holdout": False, "rmse_N": pytest.approx(NOISE, rel=0.6), "boundarys_N": {"prop": entries["prop"]["rmse_N"]},
    }  # fmt: skip
    assert entries["clamp"]["rmse_Nm"] < 3e-4
    with (run / "force.csv").open() as file:
        head, *rows = csv.reader(file)
    assert head == ["recording", "boundary", "pull_N", "data_force", "model_force"]
    assert [float(row[2]) for row in rows] == list(PULLS)
    text = "\n".join(report_lines(run))
    assert "RMSE [N]" in text
    assert "RMSE [Nm]" in text
    assert {"tracks_prop.png", "tracks_clamp.png", "overview.png"} <= {path.name for path in draw_run(run)}
    (force, _) = read_run(run).tracks()
    assert force.axis == "pull_N"
    np.testing.assert_allclose(force.time, PULLS)


def test_a_load_cell_behind_the_prop_that_was_set_to_zero(folder):
    """The force on the prop, in mN, as a change from the first line; it does not weigh what was there before."""
    problem = problem_of(scene_of(folder, PROP + CELL))
    (prop, cell) = (case.comparisons[0] for case in problem.cases)
    records = problem.cases[0].run({DENSITY: np.array(TRUE)})
    there = prop.observe(records)[:, 0, 0]
    np.testing.assert_allclose(cell.observe(records)[1:, 0, 0], -(there[1:] - there[1]), rtol=1e-12, atol=1e-15)
    assert cell.size == len(PULLS) - 1
    np.testing.assert_allclose(cell.residuals(records, 0.0), 0.0, atol=6 * NOISE)


@pytest.mark.slow
def test_poses_and_forces_in_one_fit(folder):
    """Each in its own unit; they share modulus and density. The arm of the poses has no prop."""
    unknowns = f"  {DENSITY}: {{bounds: [500, 3000]}}\n  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}\n"
    moment = CLAMP.replace("clamp.csv", "free.csv").replace("moment_Nmm", "moment_Nm")
    points = [{UPPER: pull} for pull in PULLS[:4]]
    _, records, _ = rested([f"{DENSITY}={TRUE}", f"{E}=1.4e5", f"{LOWER}=10"], points)
    rows = zip(PULLS, records.held["clamp"][1:, 2].tolist(), strict=False)
    (folder / "free.csv").write_text("pull_N,moment_Nm\n" + "\n".join(f"{p},{m}" for p, m in rows) + "\n")
    scene = scene_of(folder, recording() + moment, unknowns, ARM)
    problem = problem_of(scene)
    assert problem.unit == pytest.approx(1.0)
    result = result_of(run_sysid(scene, [], folder / "out", threads=1))
    for path, truth in ((DENSITY, TRUE), (E, 1.4e5)):
        assert result["unknowns"][path]["value"] == pytest.approx(truth, rel=5e-3)
    assert set(result["recordings"]) == {"arm", "clamp"}


def test_a_grip_that_moves_measures_the_modulus(tmp_path):
    """The force on a grip against its travel, which is a load of the model: it is in proportion to the modulus."""
    grip = "  grip: {sticky: {region: {box: {corner: [0.13, 0], size: [0.07, 0.12]}}, displacement: [0, 0]}}\nloads:\n"
    gripped = ARM.replace("loads:\n", grip).replace("gravity: [0, -9.81]", "gravity: [0, 0]")
    travel, path = (-2.0, -1.0, 1.0, 2.0, 4.0), "boundaries.grip.sticky.displacement.1"
    _, records, _ = rested([f"{E}=1.4e5", f"{LOWER}=10"], [{path: 1e-3 * mm} for mm in travel], gripped)
    force = records.held["grip"][1:, 1]
    assert (force * np.array(travel) > 0).all()
    lines = "\n".join(f"{mm},{1e3 * f}" for mm, f in zip(travel, force.tolist(), strict=True))
    (tmp_path / "grip.csv").write_text(f"travel_mm,grip_mN\n{lines}\n")
    recording = (
        "    grip: {file: grip.csv, force: {boundary: grip, component: y, column: grip_mN, "
        f"loads: {{travel_mm: {{path: {path}, factor: 0.001}}}}}}}}\n"
    )
    scene = scene_of(tmp_path, recording, f"  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}\n", gripped)
    result = result_of(run_sysid(scene, [], tmp_path / "out", threads=1))
    assert result["unknowns"][E]["value"] == pytest.approx(1.4e5, rel=1e-5)
    assert result["recordings"]["grip"]["rmse_N"] < 1e-6


# --- gradients --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("recordings", [PROP, CELL, CLAMP], ids=["force", "cell", "moment"])
def test_the_loss_has_the_adjoint_of_a_dot_product(recordings, folder, rng):
    (case,) = problem_of(scene_of(folder, recordings)).cases
    (comparison,) = case.comparisons
    records = case.run({})
    bar, _ = comparison.loss_vjp(records, 0.0, 1.7)
    change = {name: rng.normal(size=rows.shape) for name, rows in records.held.items()}

    def loss(h: float) -> float:
        moved = records.zeros_like()
        moved.add(records)
        for name, part in change.items():
            moved.held[name] += h * part
        return 1.7 * comparison.loss(moved, 0.0)

    along = sum(float((bar.held[name] * part).sum()) for name, part in change.items())
    assert along == pytest.approx((loss(1.0) - loss(-1.0)) / 2, rel=1e-9)  # exact: the loss is quadratic


def test_the_gradient_is_that_of_differences(folder):
    unknowns = f"""\
  {DENSITY}: {{bounds: [500, 3000]}}
  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}
  {LOWER}: {{bounds: [0, 100]}}
"""
    problem = problem_of(scene_of(folder, PROP + CELL + CLAMP, unknowns))
    x = problem.start + 0.013
    value, gradient = problem.value_and_grad(x)
    r = problem.residuals(x)
    assert value == pytest.approx(0.5 * r @ r, rel=1e-9)
    for k in range(3):
        h = 1e-3 * np.eye(3)[k]
        ends = [problem.value(x + j * h) for j in (-2, -1, 1, 2)]
        assert gradient[k] == pytest.approx((ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / 12e-3, rel=1e-6)


@pytest.mark.slow
def test_gradcheck_agrees(folder):
    run, agrees = run_gradcheck(scene_of(folder, PROP + CLAMP), [], folder / "out", threads=1)
    assert agrees, "\n".join(report_lines(run))


# --- signs and bad input ----------------------------------------------------------------------------------------------


def test_a_force_with_the_wrong_sign_is_asked_about(folder):
    scene = changed(scene_of(folder, PROP), "column: force_N", "column: force_N, on: boundary")
    asked = [line for line in validate(scene) if "is 'force_N' the force on the body?" in line]
    assert len(asked) == 1
    assert "if so, say `on: body`" in asked[0]
    assert not any("is 'force_N'" in line for line in validate(scene_of(folder, PROP)))
    cell = changed(scene_of(folder, CELL), "on: boundary, ", "")
    assert any("is 'cell_mN' the force on the boundary? It is" in line for line in validate(cell))


SCENES: dict[str, tuple[str, str, str]] = {
    "no such boundary": (
        "boundary: prop", "boundary: porp",
        "data.recordings.prop.force.boundary: there is no boundary 'porp' (did you mean 'prop'?)",
    ),
    "no such column": ("column: force_N", "column: forces", "prop.csv: the force 'forces' is not a column (did you"),
    "no loads": (LOADS, "ignore: [pull_N]", "prop.csv: has 8 poses, but `loads` names no column"),
    "a column that nothing uses": ("file: prop.csv", "file: cell.csv", "cell.csv: the force 'force_N' is not a column"),
    "an axis that a plane lacks": ("component: y", "component: z", "force.component: a 2D world has no axis z"),
    "no component": ("component: y, ", "", "prop.force.component: is missing"),
    "an offset": ("file: prop.csv", "file: prop.csv, offset: [1, 0]", "prop.offset: has no meaning for the"),
    "units": ("file: prop.csv", "file: prop.csv, units: mm", "prop.units: has no meaning for the measurement `force`"),
    "the updated frame": ("frame: reference", "frame: updated", "world.frame: is `updated`, but the recording 'prop'"),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_scenes_that_do_not_fit(name, folder):
    old, new, message = SCENES[name]
    scene = changed(scene_of(folder, PROP), old, new)
    with pytest.raises(SceneError) as error:
        problem_of(scene)
    assert message in str(error.value)


@pytest.mark.parametrize("what", ["offset.0", "rotation.0"])
def test_an_unknown_placement_of_forces_is_one_fault(folder, what):
    unknowns = f"  data.recordings.prop.{what}: {{bounds: [-0.1, 0.1]}}\n"
    with pytest.raises(SceneError) as error:
        load_scene(scene_of(folder, PROP, unknowns))
    (problem,) = error.value.problems
    assert problem.path == f"unknowns.data.recordings.prop.{what}"
    assert problem.message == "has no meaning for the measurement `force`: remove it"


def test_a_moment_in_a_plane_is_about_z(folder):
    scene = changed(scene_of(folder, CLAMP), "boundary: clamp,", "boundary: clamp, component: x,")
    with pytest.raises(SceneError, match=r"moment\.component: a moment in a 2D world is about z"):
        problem_of(scene)


def test_one_line_cannot_be_a_change(folder):
    (folder / "cell.csv").write_text("pull_N,cell_mN,note\n0,5,1\n")
    with pytest.raises(SceneError, match="`from_first` needs a force in the first line, and a second line"):
        problem_of(scene_of(folder, CELL))
