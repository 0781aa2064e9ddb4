"""A stress that relaxes, in whole jobs: the gradient of a motion in both frames, rest, a fit, and files."""

from __future__ import annotations

import json

import numpy as np
import pytest
from little_worlds import needs_jit
from small_beam import assert_same, result_of

from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.rest import REST
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.store.trajectory import read_trajectory

pytestmark = needs_jit

PRONY, LAW = "bodies.beam.material.prony", "bodies.beam.material.elastic.neo_hookean"
SCENE = """\
cqrun: 1
world: {size: [0.18, 0.16], dx: 0.01, gravity: [0, -9.81]}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.1], size: [0.14, 0.03]}}
    particles_per_cell: 4
    material:
      density: 1070
      elastic: {neo_hookean: {youngs_modulus: 1.5e5, poissons_ratio: 0.3}}
      prony: {ratio_1: 0.4, time_1: 0.02}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.16]}}}}
time: {duration: 0.1, control_step: 0.01}
"""
GRADIENT = """\
objective: {low: {reach: {body: beam, position: [0.1, 0.05]}}}
unknowns:
  bodies.beam.material.elastic.neo_hookean.youngs_modulus: {bounds: [5.0e4, 5.0e5], scale: log}
  bodies.beam.material.prony.ratio_1: {bounds: [0.01, 1]}
  bodies.beam.material.prony.time_1: {bounds: [0.005, 1], scale: log}
"""
FIT = """\
data:
  synthetic:
    body: beam
    truth: {bodies.beam.material.prony.ratio_1: 0.3, bodies.beam.material.prony.time_1: 0.03}
    noise: 1.0e-6
    every: 1
    markers: {tip: [0.159, 0.115], middle: [0.1, 0.115]}
unknowns:
  bodies.beam.material.elastic.neo_hookean.youngs_modulus: {bounds: [5.0e4, 5.0e5], scale: log}
  bodies.beam.material.prony.ratio_1: {bounds: [0.01, 1]}
  bodies.beam.material.prony.time_1: {bounds: [0.005, 1], scale: log}
optimizer: {least_squares: {max_iterations: 8}}
"""


def written(folder, text):
    (folder / "beam.yaml").write_text(text)
    return folder / "beam.yaml"


@pytest.mark.parametrize("frame", ["reference", "updated"])
def test_the_gradient_through_a_motion(frame, tmp_path):
    """By the modulus, the ratio and the time, against differences of whole runs."""
    scene = written(tmp_path, SCENE + GRADIENT)
    run, agrees = run_gradcheck(scene, [f"world.frame={frame}"], tmp_path / "out", threads=1)
    assert agrees
    rows = json.loads((run / "gradcheck.json").read_text())["rows"]
    assert len(rows) == 4
    assert max(row["error"] for row in rows) < 1e-8


FIBRE = "fibre: {stiffness: 3.0e+5, directions: [[1, 0]]}"
OTHERS = f"""\
      {FIBRE}
      incompressibility: {{power: 2}}
"""


@pytest.mark.slow
@pytest.mark.parametrize("frame", ["reference", "updated"])
def test_other_terms_of_the_stress_act_beside_it(frame, tmp_path):
    """With a branch of no weight, fibres and incompressibility change a motion and a gradient as they do without it."""
    before, low = SCENE.index("      prony:"), {}
    scenes = {"alone": SCENE, "before": SCENE[:before] + OTHERS + SCENE[before:]}
    weightless, none = [f"{PRONY}.ratio_1=1e-12"], [f"{PRONY}=null"]
    for name, text, overrides in (
        ("fibres", scenes["before"], none),
        ("both", scenes["before"], weightless),
        ("law", scenes["alone"], weightless),
    ):
        scene = written(tmp_path, text)
        run = run_simulate(scene, [f"world.frame={frame}", "time.duration=0.05", *overrides], tmp_path / name)
        low[name] = read_trajectory(run / "trajectory.h5").fields["x"][-1]
    assert np.abs(low["law"] - low["fibres"]).max() > 1e-4
    np.testing.assert_allclose(low["both"], low["fibres"], rtol=0, atol=1e-9)
    stiffness = "unknowns={bodies.beam.material.fibre.stiffness: {bounds: [1.0e+5, 1.0e+6]}}"
    scene = written(tmp_path, scenes["before"] + GRADIENT)
    overrides = [f"world.frame={frame}", "time.duration=0.03", stiffness]
    run, agrees = run_gradcheck(scene, overrides, tmp_path / "out", threads=1)
    assert agrees
    rows = json.loads((run / "gradcheck.json").read_text())["rows"]
    assert all(abs(row["adjoint"]) > row["noise"] and row["error"] < 1e-6 for row in rows), rows


@pytest.mark.slow
def test_the_gradient_of_a_motion_from_an_equilibrium(tmp_path):
    """The law's stress at the equilibrium is where the branch begins, so it depends on the law and on the sag."""
    clamp = "boundaries.clamp.sticky={region: {box: {corner: [0, 0], size: [0.04, 0.16]}}, displacement: [0, 0.02]}"
    scene = written(tmp_path, "start: equilibrium\n" + SCENE + GRADIENT)
    overrides = [clamp, "world.gravity=[0, -40]", "time.duration=0.03"]
    run, agrees = run_gradcheck(scene, overrides, tmp_path / "out", threads=1)
    assert agrees
    rows = json.loads((run / "gradcheck.json").read_text())["rows"]
    assert max(row["error"] for row in rows) < 1e-8


def test_it_swings_stiffer_than_it_rests(tmp_path):
    """At rest the branch is gone, so the sag is the law's; in a fast motion the beam sinks less."""
    scene = written(tmp_path, SCENE)
    none = [f"{PRONY}=null"]
    sag = {}
    for name, given in (("with", []), ("without", none)):
        rest = REST.run(scene, given, tmp_path / "out")
        sag[name] = read_trajectory(rest / "trajectory.h5").fields["x"][-1][:, 1].min()
    assert sag["with"] == pytest.approx(sag["without"], abs=1e-9)
    runs = [run_simulate(scene, given, tmp_path / "out", threads=1) for given in ([], none)]
    lowest = [read_trajectory(run / "trajectory.h5").fields["x"][:][..., 1].min() for run in runs]
    assert lowest[0] > lowest[1] + 1e-3


def test_a_motion_that_starts_at_equilibrium_stays_there(tmp_path):
    run = run_simulate(written(tmp_path, "start: equilibrium\n" + SCENE), [], tmp_path / "out", threads=1)
    x = read_trajectory(run / "trajectory.h5").fields["x"]
    assert np.abs(x[-1] - x[0]).max() < 1e-8


def test_a_fit_finds_the_branch(tmp_path):
    run = run_sysid(written(tmp_path, SCENE + FIT), [], tmp_path / "out", threads=1)
    found = result_of(run)["unknowns"]
    assert found[f"{PRONY}.ratio_1"]["value"] == pytest.approx(0.3, rel=0.02)
    assert found[f"{PRONY}.time_1"]["value"] == pytest.approx(0.03, rel=0.03)
    low, high = found[f"{PRONY}.time_1"]["interval"]
    assert low < 0.03 < high
    moduli = result_of(run)["moduli"]["beam"]
    low, high = moduli["youngs_modulus_at_once"]["interval"]
    assert low < 1.875e5 < high  # 9 K mu / (3 K + mu) of the true values, with 1.3 mu
    assert moduli["youngs_modulus"]["interval"] == pytest.approx(found[f"{LAW}.youngs_modulus"]["interval"])


def test_threads_change_no_bit(tmp_path):
    scene = written(tmp_path, SCENE)
    one, two = (run_simulate(scene, [], tmp_path / str(n), threads=n) for n in (1, 2))
    assert_same(one, two)
