"""`cqrun rest`: equilibria along a path, what is refused, what is kept when a run is stopped or killed."""

from __future__ import annotations

import csv
import shutil

import numpy as np
import pytest
from small_beam import BEAM, Listener, result_of

from cqrun.errors import RunError, SceneError, Stopped
from cqrun.figures.draw import draw_run
from cqrun.jobs.rest import REST
from cqrun.jobs.resume import run_resume
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.table import report_lines
from cqrun.store.trajectory import read_trajectory

BODY = """\
cqrun: 1
title: a small cantilever
job: rest
world: {size: [0.2, 0.2], dx: 0.01, gravity: [0, -9.81], frame: reference}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.1], size: [0.12, 0.02]}}
    particles_per_cell: 4
    groups: {tip: {box: {corner: [0.13, 0.1], size: [0.01, 0.02]}}}
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
"""
HELD = """\
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.2]}}}}
"""
ACTING = """\
loads:
  pull: {point_force: {body: beam, force: [0, 0], region: {box: {corner: [0.13, 0.1], size: [0.01, 0.02]}}}}
actuators:
  top: {muscle: {body: beam, region: {box: {corner: [0.02, 0.11], size: [0.12, 0.01]}}, axis: [1, 0], strength: 2.0e4}}
"""
PATH = """\
path:
  loads.pull.point_force.force.1: {first: 0, last: -2, points: 5}
  activation.top: [0, 0.1, 0.2, 0.3, 0.4]
"""


def rest(scene, out, *overrides, reporter=None, threads=1, fresh=False):
    return REST.run(scene, overrides, out, fresh=fresh, threads=threads, reporter=reporter)


@pytest.fixture
def scene(tmp_path):
    (tmp_path / "beam.yaml").write_text(BODY + HELD + ACTING + PATH)
    return tmp_path / "beam.yaml"


class StopsAt(Listener):
    """A reporter that asks to stop after some points."""

    def __init__(self, points):
        super().__init__()
        self.points = points

    def advance(self, done, total, text):
        if done >= self.points:
            self.stop.ask()


def rows_of(run):
    with (run / "rest.csv").open(newline="") as file:
        return [{key: float(value or "nan") for key, value in row.items()} for row in csv.DictReader(file)]


def test_a_path_gives_a_curve(scene, tmp_path):
    listener = Listener()
    run = rest(scene, tmp_path / "out", reporter=listener)
    rows, result = rows_of(run), result_of(run)
    assert (result["status"], result["message"]) == ("done", "5 points at rest")
    assert [row["loads.pull.point_force.force.1"] for row in rows] == [0, -0.5, -1, -1.5, -2]
    assert [point["values"]["activation.top"] for point in result["points"]] == [0, 0.1, 0.2, 0.3, 0.4]
    assert all(point["residual"] < 1e-8 for point in result["points"])
    weight = 1000 * 0.12 * 0.02 * 9.81
    for row in rows:  # the clamp carries the weight and the pull
        assert row["clamp.force_y"] == pytest.approx(weight - row["loads.pull.point_force.force.1"], rel=1e-6)
        assert abs(row["clamp.force_x"]) < 1e-6 * weight
    trajectory = read_trajectory(run / "trajectory.h5")
    assert len(trajectory.time) == 6
    np.testing.assert_allclose(trajectory.fields["x"][0, :, 1].max(), 0.1175)
    assert "points" not in {path.name for path in run.iterdir() if path.is_dir() and list(path.iterdir())}
    assert any("point 5 of 5" in text for *_, text in listener.parts) or listener.said
    assert any(line.startswith("5 ") for line in report_lines(run))


def test_the_moment_of_a_clamp_is_that_of_its_loads(scene, tmp_path):
    """About the centre of the held material, for a small load: force times arm."""
    run = rest(scene, tmp_path / "out", "world.gravity=[0, 0]", "path={loads.pull.point_force.force.1: [-1e-4]}")
    (row,) = rows_of(run)
    # the beam lies from x = 0.02 to 0.04 in the clamp, and the load acts on particles at 0.1325 and 0.1375
    assert row["clamp.moment"] == pytest.approx(1e-4 * (0.135 - 0.03), rel=1e-5)


def test_a_clamp_that_moves_along_the_path(scene, tmp_path):
    """A beam between two clamps, of which one goes up: the reactions balance, and grow in proportion for small ways."""
    second = "boundaries.far={sticky: {region: {box: {corner: [0.12, 0], size: [0.05, 0.2]}}, displacement: [0, 0]}}"
    run = rest(scene, tmp_path / "out", second, "world.gravity=[0, 0]",
               "path={boundaries.far.sticky.displacement.1: {first: 0, last: 2.0e-4, points: 3}}")  # fmt: skip
    rows = rows_of(run)
    assert [row["boundaries.far.sticky.displacement.1"] for row in rows] == pytest.approx([0, 1e-4, 2e-4])
    for row in rows:
        assert row["far.force_y"] == pytest.approx(-row["clamp.force_y"], abs=1e-9)
    assert rows[1]["far.force_y"] > 0
    assert rows[2]["far.force_y"] == pytest.approx(2 * rows[1]["far.force_y"], rel=1e-3)
    # clamped at both ends, EI' = E h^3 / (12 (1 - nu^2)): F = 12 EI' d / L^3, less the shear of a short beam
    slender = 12 * 1e5 / (1 - 0.3**2) * 0.02**3 / 12 * 1e-4 / 0.08**3
    assert 0.7 * slender < rows[1]["far.force_y"] < 1.1 * slender


def test_a_motion_can_start_at_rest(scene, tmp_path):
    """Under its weight, the beam stays where it is."""
    overrides = ("path={}", "start=equilibrium", "time={duration: 0.1, control_step: 0.05}", "job=simulate")
    x = read_trajectory(run_simulate(scene, overrides, tmp_path / "out", threads=1) / "trajectory.h5").fields["x"]
    assert x[0, :, 1].min() < 0.1025 - 1e-3
    np.testing.assert_allclose(x[-1], x[0], rtol=0, atol=1e-7)


def test_without_a_path_there_is_one_point(scene, tmp_path):
    run = rest(scene, tmp_path / "out", "path={}")
    (row,) = rows_of(run)
    assert row["point"] == 1
    assert row["beam.tip.dy"] < -1e-3


def test_it_rests_where_a_damped_motion_ends(scene, tmp_path):
    overrides = ("path={}", "world.gravity=[0, -2]")
    (row,) = rows_of(rest(scene, tmp_path / "out", *overrides))
    damped = (*overrides, "loads.air={damping: {rate: 30}}", "time={duration: 1.5, control_step: 0.05}", "job=simulate")
    x = read_trajectory(run_simulate(scene, damped, tmp_path / "out", threads=1) / "trajectory.h5").fields["x"]
    tip = x[0, :, 0] > 0.13
    assert (x[-1, tip, 1] - x[0, tip, 1]).mean() == pytest.approx(row["beam.tip.dy"], rel=1e-5)


def test_a_stopped_run_goes_on_to_the_same_bits(scene, tmp_path):
    whole = rest(scene, tmp_path / "whole")

    with pytest.raises(Stopped):
        rest(scene, tmp_path / "parts", reporter=StopsAt(2))
    (run,) = (tmp_path / "parts" / "beam").iterdir()
    assert len(list((run / "points").glob("*.npz"))) == 2
    saved = (run / "points" / "00000.npz").read_bytes()
    run_resume(run, [])
    assert saved
    assert (run / "rest.csv").read_bytes() == (whole / "rest.csv").read_bytes()
    assert (run / "result.json").read_bytes() == (whole / "result.json").read_bytes()


def test_a_damaged_point_is_found_again(scene, tmp_path):
    whole = rest(scene, tmp_path / "whole")

    with pytest.raises(Stopped):
        rest(scene, tmp_path / "parts", reporter=StopsAt(3))
    (run,) = (tmp_path / "parts" / "beam").iterdir()
    file = run / "points" / "00001.npz"
    file.write_bytes(file.read_bytes()[:100])
    run_resume(run, [])
    assert (run / "rest.csv").read_bytes() == (whole / "rest.csv").read_bytes()


def test_a_load_without_an_equilibrium_ends_the_path(scene, tmp_path):
    """The muscle pushes harder than the beam resists: the points before it are kept."""
    with np.errstate(all="ignore"), pytest.raises(RunError, match="no equilibrium was found at point 2"):
        rest(scene, tmp_path / "out", "path={activation.top: [-0.002, -1]}", "actuators.top.muscle.strength=3e6",
             "world.gravity=[0, 0]")  # fmt: skip
    (run,) = (tmp_path / "out" / "beam").iterdir()
    result = result_of(run)
    assert result["status"] == "failed"
    assert [point["converged"] for point in result["points"]] == [True, False]
    assert len(rows_of(run)) == 1


COLUMN = """\
cqrun: 1
title: a clamped column under a load
job: rest
world: {size: [0.06, 0.2], dx: 0.005, gravity: [0, 0]}
bodies:
  column:
    shape: {box: {corner: [0.02, 0.02], size: [0.02, 0.16]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.06, 0.04]}}}}
loads:
  push: {point_force: {body: column, force: [0, 0], region: {box: {corner: [0.02, 0.175], size: [0.02, 0.005]}}}}
path: {loads.push.point_force.force.1: [-3.0, -5.0]}
"""
"""Euler: pi^2 EI / (4 L^2 (1 - nu^2)) is 9.2 N/m; the column is thick, so that it buckles a little sooner."""


def test_a_column_beyond_its_buckling_load_is_a_finding(tmp_path):
    """Symmetric loads keep it straight, where no real column stays."""
    (tmp_path / "column.yaml").write_text(COLUMN)
    run = rest(tmp_path / "column.yaml", tmp_path / "out", "path.loads.push.point_force.force.1=[-4, -14]")
    result = result_of(run)
    assert [point["negative"] for point in result["points"]] == [False, True]
    assert any("at point 2 the stiffness has a negative eigenvalue" in finding for finding in result["findings"])


REFUSED = {
    "frame": (["world.frame=updated"], "world.frame: a body rests in the reference frame"),
    "key": (["path={loads.push.point_force.force.1: [0, 1]}"], "path.loads.push.point_force.force.1"),
    "lengths": (
        ["path={loads.pull.point_force.force.1: [0, 1], activation.top: [0, 0.5, 1]}"],
        "all keys need the same number of values: loads.pull.point_force.force.1 has 2, activation.top has 3",
    ),
    "actuator": (["path={activation.bottom: [0, 1]}"], "there is no actuator 'bottom'; the scene has top"),
    "limits": (["path={activation.top: [0, 2]}"], "2 is outside the actuator's limits, -1 to 1"),
    "shape": (["path={bodies.beam.shape.box.size.0: [0.1, 0.2]}"], "changes the rest shape of a body"),
    "a number that no force depends on": (["path={world.dx: [0.1, 0.2]}"], "path.world.dx: cannot change along a path"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_is_refused(scene, tmp_path, name):
    overrides, message = REFUSED[name]
    with pytest.raises(SceneError) as raised:
        rest(scene, tmp_path / "out", *overrides)
    assert message in str(raised.value)


def test_a_body_that_nothing_holds_is_refused(tmp_path):
    (tmp_path / "free.yaml").write_text(BODY)
    with pytest.raises(SceneError, match=r"bodies\.beam: nothing holds it: it can move in 3 ways without resistance"):
        rest(tmp_path / "free.yaml", tmp_path / "out")
    (tmp_path / "slides.yaml").write_text(BODY + HELD.replace("sticky: {", "slip: {normal: [1, 0], "))
    with pytest.raises(SceneError, match="it can move in 1 way without"):
        rest(tmp_path / "slides.yaml", tmp_path / "out")


def test_a_controller_is_refused(scene, tmp_path):
    text = scene.read_text() + "controller: {sinusoid: {frequency: 1}}\n"
    (tmp_path / "moves.yaml").write_text(text)
    with pytest.raises(SceneError, match="controller: a controller acts in time"):
        rest(tmp_path / "moves.yaml", tmp_path / "out")


def test_a_scene_for_another_job_needs_its_time(tmp_path):
    (tmp_path / "a.yaml").write_text(BEAM.partition("time:")[0])
    with pytest.raises(SceneError, match="time"):
        rest(tmp_path / "a.yaml", tmp_path / "out")


@pytest.mark.usefixtures("pictures")
def test_it_draws_the_path(scene, tmp_path):
    run = rest(scene, tmp_path / "out")
    shutil.rmtree(run / "figures", ignore_errors=True)
    assert {path.name for path in draw_run(run)} == {"bodies.png", "path.png"}
