"""A stress that relaxes in jobs that learn: control stopped and resumed, co-design of the branch, and `cqrun bench`."""

from __future__ import annotations

import json

import pytest
from little_worlds import needs_jit
from small_beam import Listener, assert_same, result_of
from test_prony_jobs import SCENE

from cqrun.errors import Stopped
from cqrun.jobs.bench import run_bench_scene
from cqrun.jobs.control import run_codesign, run_control
from cqrun.jobs.resume import run_resume
from cqrun.running.reporter import Silent
from cqrun.store.history import read_history

pytestmark = needs_jit

RATIO = "bodies.beam.material.prony.ratio_1"
LEARNING = """\
actuators:
  pull:
    muscle: {body: beam, region: {box: {corner: [0, 0], size: [0.18, 0.115]}}, axis: [1, 0], strength: 5.0e+3}
controller: {open_loop: {every: 2}}
objective: {up: {height: {body: beam}}}
optimizer: {adam: {max_iterations: 3, learning_rate: 0.1}}
"""


@pytest.fixture
def beam(tmp_path):
    (tmp_path / "beam.yaml").write_text(SCENE + LEARNING)
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
