"""A stress that relaxes in jobs that learn: control stopped and resumed, co-design of the branch, and `cqrun bench`."""

from __future__ import annotations

import json

import pytest
from little_worlds import needs_jit
from small_beam import Listener, assert_same, result_of

from cqrun.errors import Stopped
from cqrun.jobs.bench import run_bench_scene
from cqrun.jobs.control import run_codesign, run_control
from cqrun.jobs.resume import run_resume
from cqrun.running.reporter import Silent
from cqrun.store.history import read_history

pytestmark = needs_jit

RATIO = "bodies.beam.material.prony.ratio_1"
SCENE = """\
cqrun: 1
world: {size: [0.18, 0.16], dx: 0.01, gravity: [0, -9.81], frame: reference}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.1], size: [0.14, 0.03]}}
    particles_per_cell: 4
    groups: {low: {box: {corner: [0, 0], size: [0.18, 0.115]}}}
    material:
      density: 1070
      elastic: {neo_hookean: {youngs_modulus: 1.5e5, poissons_ratio: 0.3}}
      prony: {ratio_1: 0.4, time_1: 0.02}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.16]}}}}
actuators:
  pull: {muscle: {body: beam, region: low, axis: [1, 0], strength: 5.0e+3}}
controller: {open_loop: {every: 2}}
objective: {up: {height: {body: beam}}}
time: {duration: 0.04, control_step: 0.005}
optimizer: {adam: {max_iterations: 3, learning_rate: 0.1}}
"""


@pytest.fixture
def beam(tmp_path):
    (tmp_path / "beam.yaml").write_text(SCENE)
    return tmp_path / "beam.yaml"


def test_control_that_is_stopped_and_resumed_is_the_same(beam, tmp_path):
    whole = run_control(beam, [], tmp_path / "whole", threads=1)
    loss = read_history(whole / "history.csv")["loss"]
    assert loss[-1] < loss[0]
    with pytest.raises(Stopped):
        run_control(beam, [], tmp_path, threads=1, reporter=Listener(stop_after=1))
    run = tmp_path / whole.relative_to(tmp_path / "whole")
    run_resume(run, [], threads=1)
    assert_same(run, whole)


def test_the_branch_is_designed_beside_the_controller(beam, tmp_path):
    overrides = [f"unknowns={{{RATIO}: {{bounds: [0.05, 1]}}}}"]
    learned = result_of(run_codesign(beam, overrides, tmp_path, threads=1))["unknowns"][RATIO]
    assert learned["initial"] == 0.4
    assert learned["value"] > 0.4  # a stiffer beam hangs higher


def test_bench_measures_it(beam, tmp_path):
    lines = run_bench_scene(beam, [], tmp_path / "bench.json", threads=1, talk=Silent())
    assert lines
    assert json.loads((tmp_path / "bench.json").read_text())
