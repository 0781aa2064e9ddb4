"""Unknowns of one recording: tilt, start, offset and pre-load of each, beside a material that all recordings share."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_beam import BEAM, E_PATH, MARKERS, SHEAR_PATH, Listener, assert_same, result_of
from twin_recordings import NOISE, PUSH, write_twin

import cqrun
from cqrun.build.model import build
from cqrun.cli.results import draw_and_print_run
from cqrun.errors import RunError, SceneError, Stopped, UsageError
from cqrun.figures.convergence import unknown_curves
from cqrun.figures.run_data import read_run
from cqrun.fitting.case import Case
from cqrun.fitting.cases import given_cases
from cqrun.fitting.problem import FitProblem
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.jobs.validate import validate
from cqrun.measurements.comparison import Comparison
from cqrun.measurements.placement import Placement
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene
from cqrun.store.history import read_history

TRUE = 4.0e4, 6.0
"""Young's modulus [Pa] and shear viscosity [Pa s] of both recordings."""

TILTS = {"left": 1.6, "right": -1.4}
"""Sideways part of gravity in each recording [m/s^2]: it hangs 9 degrees askew."""

STARTS = {"left": 0.0213, "right": 0.0137}
OFFSET, FORCE = (1.5e-3, -0.8e-3), -0.05
"""Offset [m] and pre-load [N] of the right recording."""


def own(recording: str, path: str) -> str:
    return f"data.recordings.{recording}.overrides.{path}"


TILT = {name: own(name, "world.gravity.0") for name in TILTS}
PUSHED = "loads.push.point_force.force.0"
LOAD = own("right", "loads.push.point_force.force.1")
OFFSETS = [f"data.recordings.right.offset.{k}" for k in range(2)]

MATERIAL = f"""\
unknowns:
  {E_PATH}: {{bounds: [1.0e4, 1.0e5], scale: log}}
  {SHEAR_PATH}: {{bounds: [0.5, 40], scale: log}}
"""
POSES = f"""\
  {TILT["left"]}: {{bounds: [-4, 4]}}
  {TILT["right"]}: {{bounds: [-4, 4]}}
  data.recordings.left.start: {{bounds: [0.01, 0.03]}}
  data.recordings.right.start: {{bounds: [0.01, 0.02]}}
"""
SESSION = f"""\
  {LOAD}: {{bounds: [-0.3, 0.3]}}
  {OFFSETS[0]}: {{bounds: [-0.005, 0.005]}}
  {OFFSETS[1]}: {{bounds: [-0.005, 0.005]}}
"""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of two recordings of the same beam, turned, released, placed and loaded in different ways."""
    folder = tmp_path_factory.mktemp("recordings")
    material = [f"{E_PATH}={TRUE[0]}", f"{SHEAR_PATH}={TRUE[1]}", "time.duration=0.2"]
    for seed, name in enumerate(TILTS):
        tilt = [f"world.gravity=[{TILTS[name]}, -9.7]"]
        load = [f"loads.push.point_force.force=[0, {FORCE}]"] if name == "right" else []
        write_twin(
            folder / f"{name}.csv", [*material, *tilt, *load], start=STARTS[name], seed=seed, scene=BEAM + PUSH,
            offset=OFFSET if name == "right" else (0, 0),
        )  # fmt: skip
    return folder


def scene_of(folder: Path, unknowns: str, name: str = "session.yaml") -> Path:
    """Write a scene that is fitted to both recordings."""
    markers = ", ".join(f"{name}: {place}" for name, place in MARKERS.items())
    file = folder / name
    file.write_text(
        BEAM.replace("duration: 0.1", "duration: 0.18").replace("[0, -9.81]", "[0, -9.7]") + PUSH + f"""\
data:
  recordings:
    left: {{file: left.csv, start: 0.02, markers: &markers {{{markers}}}}}
    right: {{file: right.csv, start: 0.015, markers: *markers, overrides: {{world.gravity: [0.1, -9.7]}}}}
{unknowns}optimizer: {{least_squares: {{max_iterations: 20}}}}
""")  # fmt: skip
    return file


@pytest.fixture(scope="module")
def session(recordings: Path) -> Path:
    """Return the scene in which all that differs between the recordings is unknown."""
    return scene_of(recordings, MATERIAL + POSES + SESSION)


@pytest.fixture(scope="module")
def found(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a finished run."""
    return run_sysid(session, [], tmp_path_factory.mktemp("found"), threads=1)


def problem_of(scene: Path, *overrides: str) -> FitProblem:
    built = build(load_scene(scene, overrides))
    cases = given_cases(built)
    assert cases is not None
    return FitProblem(cases, make_params(built))


# --- what it finds ----------------------------------------------------------------------------------------------


def test_the_shared_material_is_found_and_what_each_recording_has_of_its_own(found: Path) -> None:
    result = result_of(found)
    assert result["status"] == "converged"
    truths = dict(zip((E_PATH, SHEAR_PATH), TRUE, strict=True))
    truths |= {TILT[name]: tilt for name, tilt in TILTS.items()}
    truths |= {f"data.recordings.{name}.start": start for name, start in STARTS.items()}
    truths |= {LOAD: FORCE, **dict(zip(OFFSETS, OFFSET, strict=True))}
    assert result["unknowns"].keys() == truths.keys()
    for path, truth in truths.items():
        low, high = result["unknowns"][path]["interval"]
        assert low < truth < high, path
    assert result["unknowns"][E_PATH]["value"] == pytest.approx(TRUE[0], rel=0.01)
    for name, recording in result["recordings"].items():
        assert recording["rmse_mm"] == pytest.approx(1e3 * NOISE * np.sqrt(2.0), rel=0.15), name


def test_a_tilt_that_is_shared_puts_its_error_into_the_material(recordings: Path, tmp_path: Path, found: Path) -> None:
    """The recordings lean to different sides, so one tilt fits neither: modulus, interval and errors are worse."""
    shared = POSES.replace(TILT["left"], "world.gravity.0").replace(f"  {TILT['right']}: {{bounds: [-4, 4]}}\n", "")
    scene = scene_of(recordings, MATERIAL + shared + SESSION, "shared.yaml")
    scene.write_text(scene.read_text().replace(", overrides: {world.gravity: [0.1, -9.7]}", ""))
    with_one, with_two = result_of(run_sysid(scene, [], tmp_path, threads=1)), result_of(found)
    entries = [result["unknowns"][E_PATH] for result in (with_one, with_two)]
    off, right = (abs(entry["value"] / TRUE[0] - 1.0) for entry in entries)
    assert off > 10.0 * right
    wide, narrow = (entry["interval"][1] - entry["interval"][0] for entry in entries)
    assert wide > 50.0 * narrow
    for name in TILTS:
        assert with_one["recordings"][name]["rmse_mm"] > 10.0 * with_two["recordings"][name]["rmse_mm"]


def test_results_history_pictures_and_report_name_the_recording(found: Path) -> None:
    history, result = read_history(found / "history.csv"), result_of(found)
    assert history[f"value:{TILT['right']}"][0] == pytest.approx(0.1)  # from its override
    assert history[f"value:{TILT['left']}"][0] == pytest.approx(0.0)  # from the scene
    assert history[f"value:{LOAD}"][-1] == result["unknowns"][LOAD]["value"]
    names = [curve.label for curve in unknown_curves(read_run(found))]
    assert names[2:4] == ["left: Gravity x", "right: Gravity x"]
    assert names[6:] == ["right: Force y", "right: Offset x", "right: Offset y"]
    rows = [line.split() for line in report_lines(found)]
    assert ["m/s^2", "0"] in [row[-2:] for row in rows if row[:1] == [TILT["left"]]]


@pytest.mark.usefixtures("pictures")
def test_its_pictures_are_drawn(found: Path) -> None:
    draw_and_print_run(found, quiet=True, allow_plugins=False)
    assert {"convergence.png", "tracks_left.png", "tracks_right.png"} <= {f.name for f in (found / "figures").iterdir()}


def test_the_data_in_the_table_are_moved_by_the_offset(found: Path) -> None:
    """So data and model are comparable, and their difference is the error that is reported."""
    tracks = {each.recording: each for each in read_run(found).tracks()}["right"]
    assert 1e3 * tracks.rmse() == pytest.approx(result_of(found)["recordings"]["right"]["rmse_mm"], rel=1e-9)


def test_a_replay_has_the_values_of_each_recording(found: Path, tmp_path: Path) -> None:
    replay = run_simulate(found, [], tmp_path, threads=1)
    scene, values = load_scene(replay / "scene.yaml"), result_of(found)["unknowns"]
    assert scene.recordings["left"].overrides == {"world.gravity.0": values[TILT["left"]]["value"]}
    assert scene.recordings["right"].offset == [values[path]["value"] for path in OFFSETS]


def test_stopped_and_resumed_is_never_stopped(session: Path, found: Path, tmp_path: Path) -> None:
    with pytest.raises(Stopped):
        run_sysid(session, [], tmp_path, threads=1, reporter=Listener(stop_after=2))
    (run,) = (tmp_path / "session").iterdir()
    assert run_resume(run, [], threads=1) == run
    assert_same(run, found)


def test_threads_do_not_change_a_bit(session: Path, found: Path, tmp_path: Path) -> None:
    assert_same(run_sysid(session, [], tmp_path, threads=2), found)


def test_a_bound_of_a_recordings_value_is_a_finding(session: Path, tmp_path: Path) -> None:
    run = run_sysid(session, [f"unknowns.{TILT['left']}.bounds=[-1, 1]"], tmp_path, threads=1)
    result = result_of(run)
    assert result["unknowns"][TILT["left"]]["reason"] == "at its upper bound"
    assert any(
        text.startswith(f"{TILT['left']} ended at its upper bound, 1: the best fit") for text in result["findings"]
    )
    assert f"no interval for {TILT['left']}: at its upper bound" in report_lines(run)


def test_what_the_data_of_a_recording_do_not_depend_on(session: Path, tmp_path: Path) -> None:
    """Both components of a load that only the left recording has, on particles that are clamped."""
    clamped = "{point_force: {body: beam, force: [0, 0], region: {box: {corner: [0.02, 0.06], size: [0.005, 0.01]}}}}"
    path = own("left", "loads.root.point_force.force.0")
    part = [f"data.recordings.left.overrides={{loads.root: {clamped}}}", f"unknowns.{path}={{bounds: [-1, 1]}}"]
    result = result_of(run_sysid(session, [*part, "optimizer.least_squares.max_iterations=3"], tmp_path, threads=1))
    assert result["unknowns"][path]["reason"] == "the data do not depend on it"
    assert f"{path}: the data do not depend on it; fix it, or add data that do" in result["findings"]


# --- gradients --------------------------------------------------------------------------------------------------


def test_gradcheck_agrees(session: Path, tmp_path: Path) -> None:
    run, agrees = run_gradcheck(session, ["optimizer={lbfgs: {}}"], tmp_path, threads=1)
    lines = "\n".join(report_lines(run))
    assert agrees, lines
    assert own("left", "world.gravity ") in lines
    assert "data.recordings.right.offset " in lines


def test_taylor_along_the_values_of_the_recordings(session: Path) -> None:
    problem = problem_of(session)
    x = np.clip(problem.start, 0.05, 0.95) + 0.011
    for d in np.eye(len(x))[2:]:
        value, gradient = problem.value_and_grad(x)
        steps = 1e-3 * 0.5 ** np.arange(4)
        left = [abs(problem.value(x + h * d) - value - h * float(gradient @ d)) for h in steps]
        assert np.diff(np.log(left)).max() / np.log(0.5) > 1.9


def test_the_values_of_a_recording_have_an_adjoint_by_dot_product(session: Path, rng: np.random.Generator) -> None:
    """A value of its own replaces the shared one, which then gets nothing."""
    shared = ["unknowns.world.gravity.0={bounds: [-4, 4]}", f"unknowns.{PUSHED}={{bounds: [-1, 1]}}"]
    problem = problem_of(session, *shared)
    values = {path: rng.normal(size=()) for path in problem.values(problem.start)}
    for case in problem.cases:
        its = case.own_values(values)
        assert its["world.gravity.0"] == values[TILT[case.name]]
        assert its[PUSHED] == values[PUSHED]
        assert not any(path.startswith("data.") for path in its)
        bar = {path: rng.normal(size=()) for path in its}
        by_path = case.own_values_vjp(values, bar)
        assert by_path.keys() == values.keys()
        there = sum(float(bar[path] * its[path]) for path in its)
        assert sum(float(by_path[path] * values[path]) for path in values) == pytest.approx(there, rel=1e-9)
        assert by_path["world.gravity.0"] == 0


def test_the_offset_has_an_adjoint_by_dot_product(session: Path, rng: np.random.Generator) -> None:
    (comparison,) = problem_of(session).cases[1].comparisons
    records = problem_of(session).cases[1].runner.still()
    offset, direction, r_bar = 0.01 * rng.normal(size=2), rng.normal(size=2), rng.normal(size=comparison.size)

    def placed(h: float) -> Comparison:
        return comparison.placed(Placement(offset + h * direction, np.zeros(1)))

    change = placed(1.0).residuals(records, 0.015) - placed(0.0).residuals(records, 0.015)
    assert float(r_bar @ change) == pytest.approx(float(-r_bar.reshape(-1, 2).sum(axis=0) @ direction), rel=1e-9)
    bar = Placement(offset, np.zeros(1)).vjp(*placed(0.0).measured_vjp(records, 0.015, 1.7)).offset
    ends = [1.7 * placed(h).loss(records, 0.015) for h in (1e-3, -1e-3)]
    assert float(bar @ direction) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-9)  # exact: it is quadratic


def test_a_value_of_one_recording_takes_no_rollout_of_another(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, ran, run = problem_of(session), [], Case.run

    def counted(self, values, *rest, **near):
        ran.append(self.name)
        return run(self, values, *rest, **near)

    monkeypatch.setattr(Case, "run", counted)
    r, J = problem.residuals_and_jacobian(problem.start)
    # at the start, and for the two shared unknowns; the left one's tilt; the right one's tilt and load
    assert (ran.count("left"), ran.count("right")) == (3 + 1, 3 + 2)
    size = problem.cases[0].comparisons[0].size
    paths = list(problem.params.slices)
    assert not J[size:, paths.index(TILT["left"])].any()
    assert not J[:size, paths.index(LOAD)].any()
    assert np.array_equal(r, FitProblem(problem.cases, problem.params).residuals(problem.start))


# --- scenes -----------------------------------------------------------------------------------------------------


def test_validate_says_what_each_recording_has_of_its_own(session: Path) -> None:
    text = "\n".join(validate(session))
    assert f"unknown    {TILT['right']}: -4 to 4 m/s^2, from 0.1, linear scale" in text
    assert "fitted for this recording alone: world.gravity.0, start\n" in text
    assert "alone: world.gravity.0, start, loads.push.point_force.force.1, offset.0, offset.1\n" in text
    assert "given for this recording alone: world.gravity\n" in text


def test_the_substep_is_stable_for_the_values_of_every_recording(session: Path) -> None:
    """A stiffer body in one recording needs more substeps, which all recordings then have."""
    stiff = own("left", E_PATH)
    few = build(load_scene(session, ["time.substeps=auto"]))
    many = build(load_scene(session, ["time.substeps=auto", f"unknowns.{stiff}={{bounds: [1.0e4, 1.0e6]}}"]))
    assert many.model.substeps > 2 * few.model.substeps
    with pytest.raises(
        SceneError, match=r"data.recordings.left: in its scene, time.substeps: a substep of .* use \d+ substeps"
    ):
        given_cases(build(load_scene(session, [f"data.recordings.left.overrides.{E_PATH}=1.0e6",
                                               f"unknowns={{{SHEAR_PATH}: {{bounds: [1, 10]}}}}"])))  # fmt: skip


def test_a_shape_of_one_recording_is_checked_at_its_bounds(session: Path) -> None:
    corner = own("left", "bodies.beam.shape.box.corner.1")
    (case, _) = given_cases(build(load_scene(session, [f"unknowns.{corner}={{bounds: [0.055, 0.065]}}"])))
    assert case.built.particles.x[:, 1].min() > 0.06
    moved, still = (case.built.assembly.inputs(case.own_values(v)).state.x for v in ({corner: np.array(0.062)}, {}))
    moved = moved - still
    np.testing.assert_allclose(moved, [[0.0, 0.002]] * len(moved), atol=1e-12)
    with pytest.raises(
        SceneError, match=r"data.recordings.left: in its scene, unknowns.bodies.beam.shape.box.corner.1.bounds: at 0.2"
    ):
        given_cases(build(load_scene(session, [f"unknowns.{corner}={{bounds: [0.055, 0.2]}}"])))


def test_two_recordings_of_one_session_may_share_a_tilt(session: Path) -> None:
    """The second follows the first; a third would keep the scene's."""
    tied = f"unknowns={{{TILT['left']}: {{bounds: [-4, 4], also: [{TILT['right']}]}}}}"
    problem = problem_of(session, tied)
    values = problem.values(np.array([0.75]))
    assert [case.own_values(values)["world.gravity.0"] for case in problem.cases] == [2.0, 2.0]
    x, h = np.array([0.6]), 1e-6
    _, gradient = problem.value_and_grad(x)
    slope = (problem.value(x + h) - problem.value(x - h)) / (2.0 * h)
    assert gradient[0] == pytest.approx(slope, rel=1e-6)


def test_a_given_offset_moves_the_data(recordings: Path, tmp_path: Path) -> None:
    """Also from far away, where positions would be refused as not those of the body."""
    far = tmp_path / "far.csv"
    write_twin(far, [f"{E_PATH}={TRUE[0]}", f"{SHEAR_PATH}={TRUE[1]}"], offset=(1.0, -2.0), scene=BEAM + PUSH)
    scene = scene_of(recordings, MATERIAL, "far.yaml")
    only = [f"data.recordings={{one: {{file: {far}, start: 0.02, length: 0.09, markers: {{tip: [0.119, 0.065]}}}}}}",
            "world.gravity=[0, -9.81]", f"{E_PATH}={TRUE[0]}", f"{SHEAR_PATH}={TRUE[1]}"]  # fmt: skip
    with pytest.raises(SceneError, match="marker 'tip' is never nearer than"):
        given_cases(build(load_scene(scene, only)))
    problem = problem_of(scene, *only, "data.recordings.one.offset=[1.0, -2.0]")
    (case,) = problem.cases
    values = problem.values(problem.start)
    assert np.sqrt(case.losses(case.run(values), values)[0]) == pytest.approx(NOISE * np.sqrt(2.0), rel=0.3)


def test_python_takes_the_values_of_a_recording(session: Path) -> None:
    problem = cqrun.load(session)
    loss, gradient, aux = problem.value_and_grad(
        {TILT["left"]: 0.5, own("left", "loads.push.point_force.force.0"): 0.01}
    )
    assert gradient[own("left", "loads.push.point_force.force.0")] != 0
    assert problem.value_and_grad()[2]["losses"]["right"] == aux["losses"]["right"]
    assert problem.value_and_grad()[0] != loss
    with pytest.raises(
        UsageError, match=r"data.recordings.left.overrides.bodies.beam.material.density: must be greater"
    ):
        problem.value_and_grad({own("left", "bodies.beam.material.density"): -1.0})


def test_python_refuses_a_value_of_a_recording_that_needs_more_substeps(session: Path) -> None:
    problem = cqrun.load(session, ["time.substeps=auto"])
    with pytest.raises(UsageError, match=r"bodies.beam.material: with these values the largest stable substep is"):
        problem.value_and_grad({own("left", E_PATH): 1.0e7})


def test_a_recording_that_blows_up_with_its_own_values_is_named(session: Path, tmp_path: Path) -> None:
    mad = [f"unknowns.{TILT['left']}={{bounds: [4000, 5000], initial: 5000}}"]
    with pytest.raises(RunError, match=rf"left the grid .*; trial values: .*{TILT['left']} = 4990"):
        run_sysid(session, mad, tmp_path, threads=1)
