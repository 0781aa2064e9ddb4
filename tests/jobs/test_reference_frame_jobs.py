"""Whole jobs in the reference frame: a fit, its gradients, a run forward."""

from __future__ import annotations

import json

import pytest
from small_beam import BEAM, E_PATH, FIT, SHEAR_PATH, Listener, result_of
from small_finger import DESIGN, FINGER, written

from cqrun.jobs.control import run_codesign, run_control
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.simulate import run_simulate
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.validate import validate
from cqrun.store.trajectory import read_trajectory

REFERENCE = BEAM.replace("frame: updated", "frame: reference")
ELASTIC = REFERENCE.replace("      viscosity: {shear: 3}\n", "")


@pytest.fixture
def scenes(tmp_path):
    """Return a folder with a viscous beam, its fit, and an elastic beam."""
    (tmp_path / "beam.yaml").write_text(REFERENCE)
    (tmp_path / "fit.yaml").write_text(REFERENCE + FIT)
    viscous = [line for line in FIT.splitlines() if "viscosity" not in line]
    (tmp_path / "elastic.yaml").write_text(ELASTIC + "\n".join(viscous) + "\n")
    return tmp_path


@pytest.mark.parametrize(("scene", "paths"), [("fit", (E_PATH, SHEAR_PATH)), ("elastic", (E_PATH,))])
def test_a_fit_finds_the_truth(scenes, scene, paths):
    run = run_sysid(scenes / f"{scene}.yaml", (), scenes / "out", reporter=Listener())
    result = result_of(run)
    truth = {E_PATH: 4.0e4, SHEAR_PATH: 6.0}
    for path in paths:
        low, high = result["unknowns"][path]["interval"]
        assert low < truth[path] < high
    assert result["unknowns"][E_PATH]["value"] == pytest.approx(4.0e4, rel=0.01)


@pytest.mark.parametrize("scene", ["fit", "elastic"])
def test_gradcheck_agrees(scenes, scene):
    run, agrees = run_gradcheck(scenes / f"{scene}.yaml", (), scenes / "out", reporter=Listener())
    assert agrees
    assert (run / "gradcheck.json").is_file()


SIZE = "bodies.beam.shape.box.size.0"
"""Its length; two particles in a cell let it be shorter than in the scene."""


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["fit", "elastic"])
def test_gradcheck_agrees_with_an_unknown_shape(scenes, scene):
    path = scenes / f"{scene}.yaml"
    path.write_text(
        path.read_text().replace("unknowns:", f"unknowns:\n  {SIZE}: {{bounds: [0.08, 0.1], initial: 0.09}}")
    )
    run, agrees = run_gradcheck(path, (), scenes / "out", reporter=Listener())
    found = {row["block"]: row for row in json.loads((run / "gradcheck.json").read_text())["rows"]}
    assert agrees
    assert found["bodies.beam.shape.box.size"]["adjoint"] != 0.0


@pytest.mark.slow
def test_gradcheck_agrees_with_shapes_that_are_not_unknowns(scenes):
    """All numbers of a scene that touches a floor, so points of surfaces move as well."""
    (scenes / "touching.yaml").write_text(
        ELASTIC.replace("boundaries:", "boundaries:\n  floor: {separate: {region: {box: {corner: [0, 0], "
                                       "size: [0.16, 0.0601]}}, normal: [0, 1]}}")
    )  # fmt: skip
    run, agrees = run_gradcheck(scenes / "touching.yaml", (), scenes / "out", reporter=Listener())
    found = {row["block"]: row for row in json.loads((run / "gradcheck.json").read_text())["rows"]}
    assert agrees
    assert found["bodies.beam.shape.box.corner"]["adjoint"] != 0.0


def test_a_run_forward_writes_its_trajectory(scenes):
    run = run_simulate(scenes / "beam.yaml", (), scenes / "out", reporter=Listener())
    x = read_trajectory(run / "trajectory.h5").fields["x"]
    assert len(x) == 11
    assert x[-1, :, 1].mean() < x[0, :, 1].mean() - 1e-4
    assert json.loads((run / "result.json").read_text())["status"] == "done"


@pytest.mark.parametrize(
    ("scene", "way"),
    [("elastic", "they ran the motion backwards"), ("fit", "because stresses or forces depend on velocities")],
)
def test_a_fit_says_how_its_gradients_kept_their_states(scenes, scene, way):
    run = run_sysid(scenes / f"{scene}.yaml", ["optimizer={lbfgs: {max_iterations: 2}}"], scenes / "out")
    assert way in (run / "log.txt").read_text()


def test_validate_says_how_a_gradient_keeps_its_states(scenes):
    elastic, viscous = ("\n".join(validate(scenes / f"{name}.yaml")) for name in ("elastic", "fit"))
    assert "a gradient runs the motion backwards and keeps 3 states of" in elastic
    assert "because stresses or forces depend on velocities" in viscous


LEARNS = ["world.frame=reference", "bodies.finger.sampling.lattice.count=6", "world.dx=0.08", "time.substeps=8"]


@pytest.mark.slow
@pytest.mark.parametrize(("job", "text"), [(run_control, FINGER), (run_codesign, DESIGN)], ids=["control", "codesign"])
def test_a_robot_learns_and_its_gradients_agree(tmp_path, job, text):
    """With a policy, several gradients of one rollout, and unknowns per particle."""
    scene = written(tmp_path, text)
    overrides = [*LEARNS, "optimizer={adam: {max_iterations: 4}}", *(["constraints={}"] if text is DESIGN else [])]
    run = job(scene, overrides, tmp_path / "out", threads=2)
    result = result_of(run)
    assert result["loss"] < result["start"]["loss"]
    _, agrees = run_gradcheck(scene, overrides, tmp_path / "out", reporter=Listener())
    assert agrees


def test_constraints_have_gradients_of_their_own(tmp_path):
    run = run_codesign(written(tmp_path, DESIGN), LEARNS, tmp_path / "out")
    assert set(result_of(run)["constraints"]) == {"tip", "up"}
