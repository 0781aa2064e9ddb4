"""Forces of boundaries in motion: as data, as terms and constraints, in files; and bad input."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from small_beam import Listener, result_of

from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.errors import SceneError, UsageError
from cqrun.figures.draw import draw_run
from cqrun.figures.run_data import read_run
from cqrun.fitting.cases import given_cases
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.table import report_lines
from cqrun.measurements.reaction_series import at_control_steps, at_control_steps_vjp
from cqrun.running.reaction_table import with_reactions
from cqrun.scene.load import load_scene
from cqrun.store.trajectory import read_trajectory

PULL = """\
cqrun: 1
title: a clamp pulls a bar that lies on a floor
world: {size: [0.16, 0.08], dx: 0.01, frame: reference, gravity: [0, -9.81]}
bodies:
  bar:
    shape: {box: {corner: [0.03, 0.02], size: [0.1, 0.02]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
boundaries:
  wall: {sticky: {region: {box: {corner: [0, 0.02], size: [0.04, 0.06]}}}}
  jaw: {sticky: {region: {box: {corner: [0.12, 0.02], size: [0.04, 0.06]}}, displacement: [0.004, 0]}}
  floor: {friction: {face: y_min, thickness: 0.02, coefficient: 0.3}}
time: {duration: 0.1, control_step: 0.01}
"""

E = "bodies.bar.material.elastic.fixed_corotated.youngs_modulus"
TRUE, NOISE = 1.4e5, 2.0
"""Young's modulus of the data [Pa], and the noise of the load cell [N/m]."""

FIT = """\
data:
  recordings:
    pull: {{file: pull.csv, start: 0.05, force: {{boundary: jaw, component: x, column: cell_mN, time: t_ms, {more}}}}}
unknowns:
  {E}: {{bounds: [5.0e4, 3.0e5], scale: log}}
optimizer: {{least_squares: {{max_iterations: 8}}}}
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a recording of a load cell behind the jaw: times in ms, 50 ms before the pull begins."""
    folder = tmp_path_factory.mktemp("pulls")
    (folder / "pull.yaml").write_text(PULL)
    built = with_reactions(build(load_scene(folder / "pull.yaml")))
    records = make_rollout(built.model, built.assembly.inputs({E: np.array(TRUE)})).run()
    mean, rng = records.held["jaw"][1:, 0], np.random.default_rng(3)
    time, force = np.linspace(0.0, 0.1, 41), at_control_steps(mean)
    noise = NOISE * rng.normal(size=41) * (time > 0)  # one that is set to zero at its first value is as good as that
    force = np.interp(time, 0.01 * np.arange(11), force) + noise
    with (folder / "pull.csv").open("w", newline="") as file:
        rows = zip(50 + 1e3 * time, -1e3 * force, strict=True)
        csv.writer(file).writerows([["t_ms", "cell_mN"], *rows])
    return folder


@pytest.fixture
def folder(data: Path, tmp_path: Path) -> Path:
    """Return a folder of the test's own with the recording."""
    (tmp_path / "pull.csv").write_bytes((data / "pull.csv").read_bytes())
    return tmp_path


def scene_of(folder: Path, tail: str, scene: str = PULL) -> Path:
    file = folder / "pull.yaml"
    file.write_text(scene + tail)
    return file


def fit(more: str = "on: boundary") -> str:
    return FIT.format(more=more, E=E)


# --- as data ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("more", ["on: boundary", "on: boundary, from_first: true"])
def test_a_force_curve_finds_the_stiffness(folder, more):
    run = run_sysid(scene_of(folder, fit(more)), [], folder / "out", threads=1, reporter=Listener())
    result = result_of(run)
    low, high = result["unknowns"][E]["interval"]
    assert low < TRUE < high
    assert result["unknowns"][E]["value"] == pytest.approx(TRUE, rel=0.01)
    assert result["recordings"]["pull"]["rmse_N"] == pytest.approx(NOISE, rel=0.6)
    with (run / "force_in_motion.csv").open() as file:
        head, *rows = csv.reader(file)
    assert head == ["recording", "boundary", "time", "data_force", "model_force"]
    assert len(rows) == 41
    assert "RMSE [N]" in "\n".join(report_lines(run))
    (tracks,) = read_run(run).tracks()
    assert not tracks.at_rest
    np.testing.assert_allclose(tracks.time, np.linspace(0.0, 0.1, 41), atol=1e-12)
    assert "tracks_pull.png" in {path.name for path in draw_run(run)}


@pytest.mark.slow
def test_the_gradient_of_a_fit_to_a_force_agrees(folder):
    _, agrees = run_gradcheck(scene_of(folder, fit()), (), folder / "out", reporter=Listener())
    assert agrees


def test_a_force_with_the_other_sign_is_asked_about(folder):
    run = run_sysid(scene_of(folder, fit("on: body")), [], folder / "out", threads=1, reporter=Listener())
    assert any("say `on: boundary`" in sentence for sentence in result_of(run)["findings"])


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_means_belong_to_the_middle_of_their_steps(n, rng):
    """A line in time keeps its values at control steps; and the adjoint holds."""
    middles = np.arange(n) + 0.5
    line = 2.0 + 3.0 * middles
    expected = 2.0 + 3.0 * np.arange(n + 1) if n > 1 else np.repeat(line, 2)
    np.testing.assert_allclose(at_control_steps(line), expected, rtol=1e-14)
    change, bar = rng.normal(size=n), rng.normal(size=n + 1)
    assert at_control_steps_vjp(bar) @ change == pytest.approx(bar @ at_control_steps(change), rel=1e-12)


@pytest.mark.parametrize(
    ("column", "text", "message"),
    [
        ("t_ms", "t_ms,cell_mN\n0,1\n20,2\n10,3\n200,4\n", "t_ms does not increase: 0.02 s is followed by 0.01 s"),
        ("t_ms", "time,cell_mN\n0,1\n20,2\n", "the time 't_ms' is not a column"),
        (
            "t_ms",
            "t_ms,cell_mN,other\n0,1,2\n200,2,2\n",
            "other is neither the time nor the force: add it",
        ),
        ("t_ms", "t_ms,cell_mN\n0,1\n", "a recording of a motion needs 2 or more"),
    ],
)
def test_a_recording_that_is_no_course_is_refused(folder, column, text, message):
    (folder / "pull.csv").write_text(text)
    with pytest.raises(SceneError, match=message.replace("(", r"\(")):
        given_cases(build(load_scene(scene_of(folder, fit()))))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("boundary: jaw", "boundary: jwa", "jaw"),
        ("component: x", "component: z", "a 2D world has no axis z"),
        ("on: boundary", f"on: boundary, loads: {{cell_mN: {E}}}", "belong to equilibria, and `time` to a motion"),
        ("start: 0.05", "start: 0.05, still: [0, 0.01]", "has no meaning for the measurement `force`"),
    ],
)
def test_a_recording_that_does_not_fit_the_scene_is_refused(folder, old, new, message):
    with pytest.raises(SceneError, match=message):
        load_scene(scene_of(folder, fit().replace(old, new)))


UPDATED = PULL.replace("frame: reference", "frame: updated").replace(", displacement: [0.004, 0]", "")


def test_the_updated_frame_has_no_force_in_motion(folder):
    with pytest.raises(SceneError, match=r"'jaw' is known in the reference frame alone: set `world\.frame: reference`"):
        build(load_scene(scene_of(folder, fit(), UPDATED)))


# --- as terms and constraints -----------------------------------------------------------------------------------------

WANTED = f"""\
objective:
  course: {{reaction_track: {{boundary: jaw, component: x, path: [[0, 0], [0.1, 120]]}}}}
  twist: {{reaction_track: {{boundary: wall, of: moment, component: z, path: [[0, 0.2]]}}}}
unknowns:
  {E}: {{bounds: [5.0e4, 3.0e5], scale: log}}
  boundaries.jaw.sticky.displacement.0: {{bounds: [0.001, 0.008]}}
  boundaries.floor.friction.coefficient: {{bounds: [0.1, 0.9]}}
"""


def test_the_gradient_of_a_wanted_force_agrees(folder):
    run, agrees = run_gradcheck(scene_of(folder, WANTED), (), folder / "out", reporter=Listener())
    assert agrees
    rows = json.loads((run / "gradcheck.json").read_text())["rows"]
    assert all(row["adjoint"] != 0.0 for row in rows)


@pytest.mark.slow
def test_the_gradient_holds_for_a_motion_that_starts_at_equilibrium(folder):
    """A reversed run, and one that keeps states because of a viscous material."""
    scene = "\n".join(line for line in PULL.splitlines() if "floor" not in line) + "\nstart: equilibrium\n"
    wanted = "\n".join(line for line in WANTED.splitlines() if "floor" not in line) + "\n"
    for material in ("", ", viscosity: {shear: 2}"):
        given = scene.replace("poissons_ratio: 0.3}}}", "poissons_ratio: 0.3}}" + material + "}")
        _, agrees = run_gradcheck(scene_of(folder, wanted, given), (), folder / "out", reporter=Listener())
        assert agrees, material


DRIVEN = f"""\
actuators:
  m: {{muscle: {{body: bar, axis: [1, 0], strength: 2.0e3}}}}
controller: {{open_loop: {{every: 5, initial: 0.2}}}}
objective:
  peak: {{reaction: {{boundary: floor, component: y, over: maximum}}}}
  all: {{reaction: {{boundary: jaw, over: mean, weight: 0.1}}}}
constraints:
  gentle: {{of: {{reaction: {{boundary: wall, component: x, on: boundary, over: mean}}}}, at_most: 50, scale: 10}}
unknowns:
  {E}: {{bounds: [5.0e4, 3.0e5], scale: log}}
optimizer: {{slsqp: {{max_iterations: 2}}}}
"""


@pytest.mark.slow
def test_gradients_of_forces_as_terms_and_constraints_agree(folder):
    _, agrees = run_gradcheck(scene_of(folder, DRIVEN), (), folder / "out", reporter=Listener())
    assert agrees


@pytest.mark.parametrize(
    ("term", "message"),
    [
        ("{reaction: {boundary: roof}}", "roof"),
        ("{reaction: {boundary: jaw, component: z}}", "a 2D world has no axis z"),
        ("{reaction: {boundary: jaw, of: moment, component: x}}", "a moment in a 2D world is about z"),
        (
            "{reaction_track: {boundary: jaw, component: x, path: [[0.1, 1], [0, 1]]}}",
            "must have times that begin at 0",
        ),
    ],
)
def test_a_term_that_does_not_fit_is_refused(folder, term, message):
    with pytest.raises(SceneError, match=message):
        load_scene(scene_of(folder, f"objective: {{push: {term}}}\nunknowns: {{{E}: {{bounds: [5.0e4, 3.0e5]}}}}\n"))


def test_a_term_in_the_updated_frame_is_refused(folder):
    tail = f"objective: {{push: {{reaction: {{boundary: wall}}}}}}\nunknowns: {{{E}: {{bounds: [5.0e4, 3.0e5]}}}}\n"
    with pytest.raises(SceneError, match=r"objective\.push\.reaction: the force of 'wall' is known in the reference"):
        build(load_scene(scene_of(folder, tail, UPDATED)))


# --- files ------------------------------------------------------------------------------------------------------------


def test_a_simulation_writes_the_reactions(folder):
    run = run_simulate(scene_of(folder, ""), (), folder / "out", reporter=Listener())
    with (run / "reactions.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["time"]) for row in rows] == pytest.approx([0.01 * k for k in range(1, 11)])
    stored = read_trajectory(run / "trajectory.h5").reactions
    assert set(stored.force) == {"wall", "jaw", "floor"}
    for name, force in stored.force.items():
        table = [[float(row[f"{name}.force_{axis}"]) for axis in "xy"] for row in rows]
        np.testing.assert_array_equal(force, table)
        np.testing.assert_array_equal(stored.moment[name][:, 0], [float(row[f"{name}.moment"]) for row in rows])
    assert (stored.force["jaw"][:, 0] > 0).all()  # it pulls the bar
    assert stored.force["floor"][:, 1].min() >= 0.0 < stored.force["floor"][:, 1].max()  # it carries the bar
    with h5py.File(run / "trajectory.h5") as file:
        assert file["reactions/boundaries/jaw/force"].attrs["unit"] == "N/m"
        assert file["reactions/boundaries/jaw/moment"].attrs["unit"] == "N"
    assert any(line.startswith("jaw ") for line in report_lines(run))


def test_a_reaction_that_was_changed_on_disk_is_refused(folder):
    run = run_simulate(scene_of(folder, ""), (), folder / "out", reporter=Listener())
    with h5py.File(run / "trajectory.h5", "r+") as file:
        file["reactions/boundaries/jaw/force"][3, 0] *= 1.001
    with pytest.raises(UsageError, match="control step 3 of 'reactions/boundaries/jaw/force' is not what was written"):
        read_trajectory(run / "trajectory.h5")


def test_the_reactions_of_a_bar_at_rest_are_those_of_its_equilibrium(folder):
    """A motion that starts at equilibrium, and stays there."""
    lines = [line for line in PULL.splitlines() if "floor" not in line]
    still = "\n".join(lines).replace(", displacement: [0.004, 0]", "") + "\nstart: equilibrium\n"
    built = with_reactions(build(load_scene(scene_of(folder, "", still))))
    inputs = built.assembly.inputs({})
    records = make_rollout(built.model, inputs).run()
    equilibrium = Equilibrium(built.model, inputs)
    held = equilibrium.held_by(equilibrium.solve(tolerance=1e-12).u)
    for name, (force, moment) in held.items():
        np.testing.assert_allclose(records.held[name][1:], np.tile([*force, *moment], (10, 1)), rtol=1e-6, atol=1e-7)
