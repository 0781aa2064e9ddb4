"""`--resolution`: one scene on several grids, each a run of its own, and what they show together."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from small_beam import BEAM, E_PATH, FIT, SHEAR_PATH, Listener, assert_same, changed, record, recorded, result_of

import cqrun
from cqrun.errors import SceneError, Stopped, UsageError
from cqrun.jobs.rest import REST
from cqrun.jobs.simulate import SIMULATE
from cqrun.jobs.studies.quantities import Quantity
from cqrun.jobs.studies.resolution import compared, resolution_lines, run_resolution
from cqrun.jobs.sysid import SYSID
from cqrun.store.run import read_record
from cqrun.store.study import read_resolution

ROOT = Path(__file__).parents[3]

CANTILEVER = """\
cqrun: 1
job: rest
world: {size: [0.2, 0.2], dx: 0.01, gravity: [0, -9.81], frame: reference}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.1], size: [0.12, 0.02]}}
    particles_per_cell: 4
    groups: {tip: {box: {corner: [0.12, 0.1], size: [0.02, 0.02]}}}
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 2.0e5, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.2]}}}}
time: {duration: 0.6, control_step: 0.005}
"""


@pytest.fixture
def beam(tmp_path):
    (tmp_path / "beam.yaml").write_text(CANTILEVER)
    return tmp_path / "beam.yaml"


def study(scene, out, job=REST, grids="auto", overrides=(), reporter=None, fresh=False):
    path, good = run_resolution(
        scene, overrides, out, job=job, grids=grids, threads=1, reporter=reporter, fresh=fresh
    )  # fmt: skip
    return path, read_resolution(path), good


# --- rest -------------------------------------------------------------------------------------------------------------


def test_a_sag_is_extrapolated_to_that_of_a_finer_grid(beam, tmp_path):
    listener = Listener()
    path, found, good = study(beam, tmp_path / "out", reporter=listener)
    assert good
    assert [grid.dx for grid in found.grids] == [0.01, 0.01 / 1.5]
    assert [grid.thinnest["beam"].cells for grid in found.grids] == pytest.approx([2, 3])
    sag = found.quantities["beam.tip.dy"]
    assert (sag.unit, sag.how, sag.order) == ("m", "assumed", 2.0)
    finer = REST.run(beam, ["world.dx=0.0025"], tmp_path / "fine", threads=1)
    with (finer / "rest.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    exact = float(row["beam.tip.dy"])
    assert abs(sag.value - exact) < 0.4 * abs(sag.values[-1] - exact)
    assert abs(sag.value - exact) < sag.error
    # the centre of the body moves down, and the clamp carries the weight on every grid
    assert found.quantities["beam.dy"].values[0] < -1e-3
    weight = found.quantities["clamp.force_y"]
    assert (weight.unit, weight.how) == ("N/m", "equal")
    assert weight.value == pytest.approx(1000 * 0.12 * 0.02 * 9.81, rel=1e-6)
    # each grid is an ordinary run
    alone = REST.run(beam, [], tmp_path / "alone", threads=1)
    assert_same(Path(found.grids[0].run), alone)
    assert result_of(Path(found.grids[0].run))["thinnest"]["beam"]["cells"] == pytest.approx(2)
    assert [line for line in listener.said if line.startswith("grid ")] == [
        "grid 1 of 2: cells of 0.01 m", "grid 2 of 2: cells of 0.0066667 m"]  # fmt: skip
    lines = resolution_lines(path)
    assert lines[0] == "2 of 2 grids ended, with cells of 0.01, 0.0066667 m"
    assert "cells of 0.0066667 m: beam has 3 cells and 6 particles across its thinnest part, 0.02 m" in lines
    (shown,) = [line for line in lines if line.startswith("beam.tip.dy")]
    assert shown.endswith("2, assumed")
    assert any("2 times the change between the grids" in line for line in lines)
    table = list(csv.DictReader(path.with_suffix(".csv").read_text().splitlines()))
    assert float({row["quantity"]: row for row in table}["beam.tip.dy"]["extrapolated"]) == sag.value


def test_three_grids_show_the_order(beam, tmp_path):
    found = cqrun.resolution(beam, grids=[0.01, 0.01 / 1.5, 0.005], out=tmp_path / "out", threads=1)
    sag = found.quantities["beam.tip.dy"]
    assert sag.how == "observed"
    assert 1.0 < sag.order < 2.5
    assert sag.values[0] < sag.values[1] < sag.values[2] < sag.value < 0
    assert sag.error > abs(sag.value - sag.values[2])


def test_what_does_not_suit_a_grid_is_said_before_the_first_run(beam, tmp_path):
    """A pin of 6 mm holds a particle on one grid alone."""
    pin = "boundaries.pin={sticky: {region: {box: {corner: [0.136, 0.097], size: [0.006, 0.006]}}}}"
    listener, updated = Listener(), ["world.frame=updated", "time.duration=0.01", pin]
    study(beam, tmp_path / "out", SIMULATE, "0.01,0.007", updated, listener)
    first = listener.said.index("grid 1 of 2: cells of 0.01 m")
    holds_none = [k for k, line in enumerate(listener.said) if "holds 1 nodes but no particle" in line]
    assert len(holds_none) == 1  # not again when this grid begins
    assert holds_none[0] < first
    assert listener.said[holds_none[0]].endswith("let the region reach into it (with cells of 0.007 m)")


def test_problems_of_all_grids_are_reported_before_any_run(beam, tmp_path):
    """A group between particles is empty on two of three grids."""
    group = "bodies.beam.groups.spot={box: {corner: [0.0615, 0.105], size: [0.0007, 0.002]}}"
    with pytest.raises(SceneError) as refused:
        study(beam, tmp_path / "out", grids="0.01,0.008,0.005", overrides=[group])
    told = [str(problem) for problem in refused.value.problems]
    assert [line.partition(": with cells of ")[2].partition(" m:")[0] for line in told] == ["0.01", "0.005"]
    assert not (tmp_path / "out").exists()


class StopsOnGrid(Listener):
    """A reporter that asks to stop when a grid begins."""

    def __init__(self, number):
        super().__init__()
        self.number = number

    def phase(self, text):
        super().phase(text)
        if text.startswith(f"grid {self.number} "):
            self.stop.ask()


def same_study(path, other):
    """Fail if two studies in different folders differ."""
    here, there = (json.loads(each.read_text()) for each in (path, other))
    for mine, theirs in zip(here["grids"], there["grids"], strict=True):
        assert_same(Path(mine.pop("run")), Path(theirs.pop("run")))
    assert here == there
    assert path.with_suffix(".csv").read_bytes() == other.with_suffix(".csv").read_bytes()


def test_a_stopped_study_goes_on_to_the_same_bits(beam, tmp_path):
    path = ["path={world.gravity.1: [-2, -4, -9.81]}"]
    whole, _, _ = study(beam, tmp_path / "whole", overrides=path)
    with pytest.raises(Stopped, match="1 of 2 grids are finished; the same command continues"):
        study(beam, tmp_path / "parts", overrides=path, reporter=StopsOnGrid(2))
    assert not list((tmp_path / "parts").glob("*/resolution*"))
    listener = Listener()
    other, _, _ = study(beam, tmp_path / "parts", overrides=path, reporter=listener)
    assert any("finished already" in line for line in listener.said)
    same_study(whole, other)


def test_a_killed_study_goes_on_to_the_same_bits(beam, tmp_path):
    whole, _, _ = study(beam, tmp_path / "whole")
    command = [sys.executable, "-m", "cqrun", "rest", str(beam), "--resolution", "-q", "--threads", "1"]
    command += ["--out", str(tmp_path / "killed")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CQRUN_PICTURES": "0"}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 300
    while len(list((tmp_path / "killed").glob("*/*/run.json"))) < 2 and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.002)  # until the second grid begins
    process.kill()
    process.communicate()
    other, _, _ = study(beam, tmp_path / "killed")
    same_study(whole, other)


# --- simulate ---------------------------------------------------------------------------------------------------------


def test_a_swing_has_a_frequency_and_a_deflection(beam, tmp_path):
    _, found, good = study(beam, tmp_path / "out", SIMULATE, overrides=["world.gravity=[0, -1]"])
    assert good
    for name in ("beam", "beam.tip"):
        rate = found.quantities[f"{name}.frequency"]
        assert rate.unit == "Hz"
        # a clamped bar of free length L: 1.875^2 / (2 pi L^2) sqrt(E' h^2 / (12 rho)), less the shear of a short bar
        slender = 1.8751**2 / (2 * np.pi * 0.1**2) * np.sqrt(2e5 / 0.91 * 0.02**2 / 12 / 1000)
        assert rate.value == pytest.approx(slender, rel=0.06)
        assert rate.values[0] < rate.values[1] < rate.value
    tip, centre = (found.quantities[f"{name}.largest_deflection"] for name in ("beam.tip", "beam"))
    assert tip.values[1] > 2 * centre.values[1] > 0
    assert found.quantities["beam.tip.deflection"].values[1] <= tip.values[1]


def test_a_run_that_fails_on_one_grid(beam, tmp_path):
    """The muscle has no equilibrium on any grid; what there is is reported."""
    acting = "actuators={top: {muscle: {body: beam, axis: [1, 0], strength: 3.0e6}}}"
    overrides = [acting, "world.gravity=[0, 0]", "path={activation.top: [-0.002, -1]}"]
    with np.errstate(all="ignore"):
        path, found, good = study(beam, tmp_path / "out", overrides=overrides)
    assert not good
    assert [grid.status for grid in found.grids] == ["failed", "failed"]
    assert found.quantities == {}
    assert any("failed: no equilibrium was found at point 2" in line for line in resolution_lines(path))


# --- sysid ------------------------------------------------------------------------------------------------------------


def test_a_fit_to_a_recording(tmp_path):
    """The data come from the coarse grid, on which the beam is softer: the fine grid finds a softer material."""
    (file,) = record(tmp_path / "fit.yaml", tmp_path / "data")
    scene = changed(recorded(tmp_path / "fit.yaml", {"made": file}), "[1.0e4, 1.0e5]", "[1.0e4, 4.0e5]")
    listener = Listener()
    path, found, good = study(scene, tmp_path / "out", SYSID, reporter=listener)
    assert good
    stiffness = found.quantities[E_PATH]
    assert stiffness.unit == "Pa"
    assert stiffness.values[0] == pytest.approx(4e4, rel=0.02)
    assert stiffness.values[1] < 0.95 * stiffness.values[0]
    assert 0 < stiffness.value < stiffness.values[1]
    assert stiffness.value == pytest.approx(stiffness.values[1] * (stiffness.values[1] / stiffness.values[0]) ** 0.8)
    damping = found.quantities[SHEAR_PATH]
    assert (damping.value, damping.note) == (None, "ended at a bound: 20 with cells of 0.0066667 m")
    assert found.quantities["made: RMSE"].unit == "mm"
    assert found.grids[1].overrides == ["world.dx=0.006666666666666667", "time.substeps=36"]
    assert any("time.substeps is 24 in the scene, and 36 with" in line for line in found.notes)
    assert f"note: {SHEAR_PATH}: {damping.note}" in resolution_lines(path)
    for grid in found.grids:
        assert read_record(Path(grid.run))["job"] == "sysid"


def test_synthetic_data_do_not_show_the_grid(tmp_path):
    (tmp_path / "twin.yaml").write_text(BEAM + FIT)
    _, found, good = study(tmp_path / "twin.yaml", tmp_path / "out", SYSID)
    assert good
    assert found.quantities[E_PATH].value == pytest.approx(4e4, rel=0.02)
    assert any("each grid makes its own" in note for note in found.notes)


def test_an_unknown_at_a_bound_is_not_extrapolated():
    found = [{"E": Quantity(100.0, "Pa", bound=100.0)}, {"E": Quantity(90.0, "Pa")}]
    entry = compared([0.02, 0.01], found)["E"]
    assert entry.values == [100.0, 90.0]
    assert entry.value is None
    assert entry.note == "ended at a bound: 100 with cells of 0.02 m"


def test_a_value_outside_its_interval():
    fine = {"E": Quantity(90.0, "Pa", interval=(88.0, 92.0))}
    entry = compared([0.02, 0.01], [{"E": Quantity(100.0, "Pa")}, fine])["E"]
    assert entry.value == pytest.approx(90 - 10 / 3)
    assert "outside the 95 % interval on the finest grid, 88 to 92" in entry.note
    assert compared([0.02, 0.01], [{"E": Quantity(91.0, "Pa")}, fine])["E"].note is None


def test_an_error_is_not_negative():
    found = [{"made: RMSE": Quantity(value, "mm", least=0.0)} for value in (3.0, 1.0)]
    entry = compared([0.01, 0.01 / 1.5], found)["made: RMSE"]
    assert (entry.value, entry.error) == (0.0, pytest.approx(4.0))


def test_a_quantity_that_one_grid_lacks():
    entry = compared([0.02, 0.01], [{}, {"f": Quantity(3.0, "Hz")}])["f"]
    assert (entry.values, entry.value) == ([None, 3.0], None)
    assert entry.note == "has no value with cells of 0.02 m"
    assert compared([0.02, 0.01], [None, {"f": Quantity(3.0, "Hz")}])["f"].value is None


# --- what is refused --------------------------------------------------------------------------------------------------


def test_grids_that_cannot_be_are_refused_before_anything_runs(beam, tmp_path):
    for grids, message in (("0.01,0.01", "are the same grid"), ("0.04,0.01", "coarser than the body 'beam'")):
        with pytest.raises(UsageError, match=message):
            study(beam, tmp_path / "out", grids=grids)
    assert not (tmp_path / "out").exists()


def test_a_problem_of_one_grid_names_it(beam, tmp_path):
    with pytest.raises(SceneError, match=r"with cells of 0.01 m: a body rests in the reference frame"):
        study(beam, tmp_path / "out", overrides=["world.frame=updated"])


def test_a_run_is_no_scene(beam, tmp_path):
    run = REST.run(beam, [], tmp_path / "out", threads=1)
    with pytest.raises(UsageError, match="give the scene file, not a run"):
        study(run, tmp_path / "out", SIMULATE)


def test_other_jobs_are_refused(beam, tmp_path):
    with pytest.raises(UsageError, match="compares the grids of sysid, rest, simulate, not of control"):
        cqrun.resolution(beam, job="control", out=tmp_path)
