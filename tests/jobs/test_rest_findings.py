"""What `cqrun rest` says about its points, and about scenes that have no rest or say more than rest needs."""

from __future__ import annotations

import numpy as np
import pytest
from small_beam import Listener, result_of
from test_rest import ACTING, BODY, COLUMN, HELD, rest

from cqrun.build.model import build
from cqrun.engine.statics.path import RestPath
from cqrun.errors import SceneError
from cqrun.jobs import rest as module
from cqrun.jobs.simulate import SIMULATE
from cqrun.jobs.validate import validate
from cqrun.scene.load import load_scene
from cqrun.store.run import read_record

TIME = "time: {duration: 0.1, control_step: 0.1}\n"
LOAD = "loads.push.point_force.force.1"


@pytest.fixture
def beam(tmp_path):
    (tmp_path / "beam.yaml").write_text(BODY + HELD)
    return tmp_path / "beam.yaml"


# --- stability --------------------------------------------------------------------------------------------------------


def test_the_smallest_eigenvalue_falls_through_zero_at_the_buckling_load(tmp_path):
    """In proportion to the load, as Euler says, on both sides of it."""
    (tmp_path / "column.yaml").write_text(COLUMN)
    run = rest(tmp_path / "column.yaml", tmp_path / "out", "path={loads.push.point_force.force.1: [-2, -4, -12, -14]}")
    result = result_of(run)
    low, high, beyond, far = (point["smallest"] for point in result["points"])
    slope = (high - low) / 2
    critical = 2 + low / -slope
    assert 6 < critical < 10
    assert [point["negative"] for point in result["points"]] == [False, False, True, True]
    assert far < beyond < 0
    assert (far - beyond) / 2 == pytest.approx(slope, rel=0.3)
    assert any(
        "between point 2 and point 3 the smallest eigenvalue changes" in finding for finding in result["findings"]
    )
    assert not any("limit point is near" in finding for finding in result["findings"])
    # a path of one point is compared with the rest shape
    a, b = 0.9 * critical, 0.94 * critical
    at_a, at_b = (point["smallest"] for point in _at(tmp_path, a, b)["points"])
    critical = a + (b - a) * at_a / (at_a - at_b)
    assert any("a limit point is near point 1" in finding for finding in _at(tmp_path, 0.99 * critical)["findings"])
    assert any("between the rest shape and point 1" in finding for finding in _at(tmp_path, 1.2 * critical)["findings"])


def _at(tmp_path, *loads):
    """Return the result of the column under loads."""
    path = f"path={{{LOAD}: {[-load for load in loads]}}}"
    return result_of(rest(tmp_path / "column.yaml", tmp_path / "out", path))


ARCH = """\
cqrun: 1
title: a shallow arch between two clamps
job: rest
world: {size: [0.4, 0.12], dx: 0.01, gravity: [0, 0], frame: reference}
bodies:
  arch:
    shape: {polygon: {points: [[0.05, 0.02], [0.2, 0.07], [0.35, 0.02], [0.35, 0.035], [0.2, 0.085], [0.05, 0.035]]}}
    particles_per_cell: 16
    material: {density: 1000, elastic: {fixed_corotated: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
boundaries:
  left: {sticky: {region: {box: {corner: [0, 0], size: [0.08, 0.12]}}}}
  right: {sticky: {region: {box: {corner: [0.32, 0], size: [0.08, 0.12]}}}}
loads:
  push: {point_force: {body: arch, force: [0, 0], region: {box: {corner: [0.19, 0.06], size: [0.02, 0.04]}}}}
path: {loads.push.point_force.force.1: [-10, -60]}
"""


def test_an_arch_that_snaps_through_is_a_finding(tmp_path):
    (tmp_path / "arch.yaml").write_text(ARCH)
    result = result_of(rest(tmp_path / "arch.yaml", tmp_path / "out"))
    first, second = result["points"]
    assert first["jump"] is None
    assert second["converged"]
    assert second["jump"] > 0.04  # it is 5 cm high
    assert 0 < second["jump_at"] <= 1
    (finding,) = [finding for finding in result["findings"] if "the body jumps" in finding]
    assert "on the way to point 2" in finding
    assert f"{LOAD} = -" in finding


def test_a_beam_that_bends_far_in_one_step_does_not_jump(beam, tmp_path):
    """Its tip goes down by three quarters of its length."""
    result = result_of(rest(beam, tmp_path / "out", "world.gravity=[0, -60]"))
    assert result["points"][0]["jump"] is None
    assert result["findings"] == []


# --- bodies that nothing holds, or that cannot move -------------------------------------------------------------------


def test_a_body_wholly_in_a_clamp_stays_where_it_is(beam, tmp_path):
    listener = Listener()
    run = rest(beam, tmp_path / "out", "boundaries.clamp.sticky.region.box.size=[0.2, 0.2]", reporter=listener)
    assert result_of(run)["status"] == "done"
    assert any("bodies.beam: nothing of it can move: 'clamp' holds every node" in said for said in listener.said)


def test_a_run_with_a_fault_says_that_it_failed(beam, tmp_path, monkeypatch):
    def fails(*_, **__):
        raise ZeroDivisionError("a fault")

    monkeypatch.setattr(RestPath, "run", fails)
    with pytest.raises(ZeroDivisionError):
        rest(beam, tmp_path / "out")
    (run,) = (tmp_path / "out" / "beam").iterdir()
    record = read_record(run)
    assert (record["status"], record["reason"]) == ("failed", "ZeroDivisionError: a fault")


@pytest.mark.parametrize("more", ["", "start: equilibrium\n"])
def test_validate_finds_a_body_that_nothing_holds(tmp_path, more):
    text = BODY + TIME + more
    (tmp_path / "free.yaml").write_text(text.replace("job: rest", "job: simulate") if more else text)
    with pytest.raises(SceneError, match=r"bodies\.beam: nothing holds it: it can move in 3 ways"):
        list(validate(tmp_path / "free.yaml"))


def test_validate_accepts_a_body_that_is_held(beam):
    assert any("a valid scene" in line for line in validate(beam))


@pytest.mark.parametrize("more", ["", "start: equilibrium\n"])
def test_single_precision_is_refused_by_name(tmp_path, more):
    (tmp_path / "a.yaml").write_text(BODY + HELD + TIME + more + "precision: float32\n")
    with pytest.raises(SceneError, match="precision: is float32, too coarse for bodies at rest: use float64"):
        rest(tmp_path / "a.yaml", tmp_path / "out")


FAR = "  far: {sticky: {region: {box: {corner: [0.03, 0], size: [0.04, 0.2]}}%s}}\n"
SHARED = {
    "one moves": (", displacement: [0.01, 0]", "boundaries.far: 'far' and 'clamp' both hold", "go where 'far' goes"),
    "none moves": ("", "boundaries.clamp: 'clamp' and 'far' both hold", "counts for 'clamp', the first in the scene"),
}


@pytest.mark.parametrize("name", SHARED)
def test_two_clamps_on_the_same_nodes_are_named(name):
    fields, *parts = SHARED[name]
    warnings = [str(warning) for warning in build(load_scene(BODY + HELD + FAR % fields)).warnings]
    (said,) = [warning for warning in warnings if "both hold" in warning]
    assert all(part in said for part in parts)


# --- what has no effect -----------------------------------------------------------------------------------------------

IDLE = {
    "velocity": ("bodies.beam.velocity=[1, 0]", "bodies.beam.velocity"),
    "spin": ("bodies.beam.spin=[1]", "bodies.beam.spin"),
    "viscosity": ("bodies.beam.material.viscosity={shear: 1}", "bodies.beam.material.viscosity"),
    "damping": ("loads.air={damping: {rate: 3}}", "loads.air.damping"),
    "over": (
        "boundaries.clamp.sticky={region: {box: {corner: [0, 0], size: [0.04, 0.2]}}, displacement: [0, 0], over: 1}",
        "boundaries.clamp.sticky.over",
    ),
}


@pytest.mark.parametrize("name", IDLE)
def test_what_has_no_effect_at_rest_is_named(beam, name):
    override, path = IDLE[name]
    listener = Listener()
    module.REST.prepare(load_scene(beam, [override]), 1, listener)
    assert any(f"{path}: has no effect at rest" in said for said in listener.said), listener.said


ALONG = {
    "strength": (
        ["path={actuators.top.muscle.strength: [0, 1.0e4]}"],
        "path.actuators.top.muscle.strength: 'actuators.top.muscle.strength' does nothing, because the activation",
    ),
    "nothing": ([], "actuators.top.muscle.strength: 'actuators.top.muscle.strength' does nothing"),
    "velocity": (["path={bodies.beam.velocity.0: [0, 1]}"], "path.bodies.beam.velocity.0: has no effect at rest"),
}


@pytest.mark.parametrize("name", ALONG)
def test_what_has_no_effect_along_a_path_is_named(tmp_path, name):
    overrides, message = ALONG[name]
    (tmp_path / "a.yaml").write_text(BODY + HELD + ACTING)
    listener = Listener()
    module.REST.prepare(load_scene(tmp_path / "a.yaml", overrides), 1, listener)
    assert any(message in said for said in listener.said), listener.said


def test_an_activation_along_a_path_has_an_effect(tmp_path):
    (tmp_path / "a.yaml").write_text(BODY + HELD + ACTING)
    listener = Listener()
    path = "path={activation.top: [0, 1], actuators.top.muscle.strength: [1.0e4, 2.0e4]}"
    module.REST.prepare(load_scene(tmp_path / "a.yaml", [path]), 1, listener)
    assert not any("does nothing" in said for said in listener.said), listener.said


def test_a_path_along_which_nothing_moves_has_no_jump(tmp_path):
    """Rounding moves the body by 1e-12 m from one point to the next."""
    (tmp_path / "a.yaml").write_text(BODY + HELD + ACTING)
    path, load = "path={actuators.top.muscle.strength: [0, 5, 2]}", "loads.pull.point_force.force=[0, -2]"
    turned = ["boundaries.clamp.sticky.displacement=[0, 0.01]", "boundaries.clamp.sticky.rotation=[0.2]"]
    result = result_of(rest(tmp_path / "a.yaml", tmp_path / "out", path, load, *turned))
    assert not any("jumps" in finding for finding in result["findings"]), result["findings"]


def test_a_path_has_no_effect_on_a_motion(tmp_path):
    path = "path: {loads.pull.point_force.force.1: [0, -1]}\n"
    (tmp_path / "a.yaml").write_text((BODY + HELD + ACTING + path + TIME).replace("job: rest", "job: simulate"))
    listener = Listener()
    SIMULATE.prepare(load_scene(tmp_path / "a.yaml"), 1, listener)
    assert any("path: has no effect on a motion: `cqrun rest` goes along it" in said for said in listener.said)


def test_a_residual_that_rounding_leaves_is_a_finding(beam, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "TOLERANCE", 1e-17)
    with np.errstate(all="ignore"):
        result = result_of(rest(beam, tmp_path / "out"))
    assert result["points"][0]["converged"]
    assert result["points"][0]["rounded"]
    assert any("at point 1 rounding ended the search: the residual is" in finding for finding in result["findings"])
