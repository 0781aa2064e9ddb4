"""`cqrun validate`: what it tells of a scene, and what it refuses."""

from __future__ import annotations

import re

import numpy as np
import pytest
from small_beam import changed, record, recorded

from cqrun.errors import SceneError
from cqrun.jobs.validate import validate

MUSCLES = """\
actuators:
  bend: {muscle: {body: beam, axis: [1, 0], strength: 10, region: long}}
  all: {muscle: {body: beam, axis: [1, 0], strength: 10}}
boundaries:"""


REGIONS = """\
regions:
  front: {box: {corner: [0, 0], size: [0.045, 0.12]}}
  below: {box: {corner: [0, 0], size: [0.16, 0.05]}}
boundaries:"""


def told(scene, *overrides) -> str:
    return "\n".join(validate(scene, overrides))


def test_it_counts_and_weighs(beam):
    text = told(beam)
    assert f"{beam}: a valid scene: a small cantilever" in text
    assert "0.16 x 0.12 m in cells of 0.01 m: 24 x 20 = 480 nodes" in text
    assert re.search(r"clamp \(sticky, \d+ nodes, 10 particles\)", text)  # up to x = 0.045 m
    assert "40 particles, 4 per cell, 0.005 m apart; mass 1 kg/m" in text  # 0.1 m x 0.01 m x 1000 kg/m^3
    assert "from (0.0225, 0.0625) to (0.1175, 0.0675) m, 0.0225 m from the nearest face of the world" in text
    assert "1 cell and 2 particles across its thinnest part, 0.01 m\n" in text
    assert "groups: root 20\n" in text
    assert "10 control steps of 0.01 s, each of 24 substeps of 0.00041667 s: 240 substeps" in text
    assert re.search(r"0\.\d\d of the largest stable substep, 0.00\d+ s \(bodies.beam.material\)", text)
    assert re.search(r"a gradient keeps 241 states of \S+ KiB, \S+ [KM]iB of a budget of 2 GiB: no substep runs", text)
    assert "an estimate, for one core: " in text


def test_it_counts_what_every_part_and_actuator_holds(beam):
    box = "shape: {box: {corner: [0.02, 0.06], size: [0.1, 0.01]}}"
    short, long = (f"{{box: {{corner: [{x}, 0.06], size: [0.05, 0.01]}}}}" for x in (0.02, 0.07))
    changed(beam, box, f"parts: {{short: {short}, long: {long}}}")
    changed(beam, "particles_per_cell: 4", "sampling: {lattice: {count: 5}}")
    changed(beam, "boundaries:", MUSCLES)
    text = told(beam, "bodies.beam.place={offset: [0.01, 0], scale: 0.9}")
    assert "body beam  50 particles, 6.1728 per cell, 0.0040249 m apart; mass 0.81 kg/m" in text
    assert "from (0.0325, 0.0549) to (0.1135, 0.0621) m" in text
    assert "groups: short 25, long 25, root 25\n" in text
    assert "actuator   bend (muscle): 25 particles of 'beam'\n" in text
    assert "actuator   all (muscle): 50 particles of 'beam'\n" in text


def test_it_counts_the_particles_of_groups_and_regions(beam):
    changed(beam, "boundaries:", REGIONS)
    text = told(beam)
    assert "groups: root 20\n" in text
    assert "region     front: 10 particles of 'beam'\n" in text
    assert "region     below: no particle\n" in text


def test_it_says_if_the_units_are_probably_not_those_of_its_labels(beam):
    sentence = "  units      gravity or stiffness is unlike that in SI units, but labels name SI units even so"
    modulus = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus=40"
    assert sentence not in told(beam)
    assert sentence in told(beam, "world.gravity=[0, -981]").splitlines()
    assert sentence in told(beam, "world.gravity=[0, 0]", modulus).splitlines()


def test_it_tells_what_float32_rounds_away(beam):
    assert "loses motion" not in told(beam)
    slow = np.finfo(np.float32).eps * 0.16 / (0.01 / 24)
    assert f"float32 loses motion slower than about {slow:.5g} m/s" in told(beam, "precision=float32")


def test_it_warns_of_a_body_that_float32_leaves_where_it_is(beam):
    slow, fast = "bodies.beam.velocity=[0, -1e-6]", "bodies.beam.velocity=[0, -1e-4]"
    assert "bodies.beam.velocity: starts at" not in told(beam, slow)
    text = told(beam, "precision=float32", slow)
    assert f"warning: -o {slow}: bodies.beam.velocity: starts at 1e-06 m/s, but float32 loses motion slower" in text
    assert "bodies.beam.velocity: starts at" not in told(beam, "precision=float32", fast)


def test_an_actuator_over_no_particles_is_refused(beam):
    away = "region: {ball: {center: [0.1, 0.1], radius: 0.01}}"
    changed(beam, "boundaries:", MUSCLES.replace("region: long", away))
    with pytest.raises(SceneError, match=r"actuators.bend.muscle.region: holds no particle: 'beam' lies within"):
        told(beam)


def test_the_bound_is_that_of_the_unknowns_worst_corner(fit):
    changed(fit, "substeps: 24", "substeps: auto")
    text = told(fit)
    share = re.search(r"(0.\d\d) of the .* \(bodies.beam.material at the worst corner of the unknowns' bounds\)", text)
    assert share
    assert 0.5 < float(share[1]) <= 0.6
    assert "viscosity.shear: 0.5 to 20 Pa s, from 3, log scale" in text
    assert "least_squares, at most 8 iterations" in text
    assert "synthetic: 1 x 1 recordings of 2 markers on 'beam', noise 0.02 mm" in text


def test_a_small_budget_costs_repetitions(beam):
    found = re.search(r"keeps (\d+) states .*: (\S+) forward substeps for each", told(beam, "memory=128KiB"))
    assert found
    assert int(found[1]) < 100
    assert float(found[2]) > 1.0


def test_too_little_memory_for_gradients_is_a_warning_where_none_are_asked_for(beam, fit):
    assert "warning: no gradients: -o memory=2KiB: memory: a gradient needs 10 states" in told(beam, "memory=2KiB")
    changed(fit, "title: a small cantilever", "job: sysid")
    assert "warning: no gradients" in told(fit, "memory=2KiB")  # least squares needs none
    with pytest.raises(SceneError, match="-o memory=2KiB: memory: a gradient needs 10 states"):
        told(fit, "memory=2KiB", "optimizer={lbfgs: {}}")


def test_a_substep_near_its_bound_is_a_warning(beam):
    assert "warning: -o time.substeps=9: time.substeps: a substep of" in told(beam, "time.substeps=9")


def test_recordings_are_read_and_aligned(fit, tmp_path):
    (file,) = record(fit, tmp_path / "data")
    text = told(recorded(fit, {"one": file}))
    assert "one (fitted): 2 markers, 11 frames from 0 to 0.1 s, release at 0 s, 100.0% seen" in text
    assert "positions in the scene's own frame" in text
    text = told(recorded(fit, {"one": file}, still="[0, 0.02]", start="0.02", length="0.06", holdout="false"))
    assert "one (fitted): 2 markers, 7 frames from 0.02 to 0.08 s, release at 0.02 s" in text
    assert re.search(r"aligned to the rest positions within 0.\d\d to 0.\d\d mm", text)


def test_a_recording_that_cannot_be_used_is_refused(fit, tmp_path):
    (file,) = record(fit, tmp_path / "data")
    scene = recorded(fit, {"one": file}, start="0.05")
    with pytest.raises(SceneError, match=r"data.recordings.one: .*the window, 0.05 to 0.15 s .* does not lie inside"):
        told(scene)


def test_an_objective_that_unknowns_make_small(fit):
    text = fit.read_text()
    there = "objective: {there: {track: {body: beam, keys: [[0.1, 0.07, 0.055]]}}}\n"
    fit.write_text(text[: text.index("data:")] + there + text[text.index("unknowns:") : text.index("optimizer:")])
    text = told(fit)
    assert "objective  there (track): mean, weight 1, smaller is better" in text
    assert "optimizer  lbfgs, at most" in text


def test_a_scene_for_sysid_needs_data_and_unknowns(beam):
    changed(beam, "title: a small cantilever", "job: sysid")
    with pytest.raises(SceneError, match="unknowns: sysid needs it"):
        told(beam)


def test_a_scene_at_rest_shows_its_points_and_no_motion(tmp_path):
    (tmp_path / "rest.yaml").write_text(AT_REST)
    text = "\n".join(validate(tmp_path / "rest.yaml"))
    assert "rest       2 points, along boundaries.clamp.sticky.rotation.0" in text
    assert " displacements of " in text
    assert "substep" not in text
    assert "memory" not in text


def test_what_rest_refuses_is_not_called_valid(tmp_path):
    (tmp_path / "rest.yaml").write_text(AT_REST + "  floor: {friction: {face: y_min, coefficient: 0.5}}\n")
    with pytest.raises(SceneError, match="an equilibrium feels contact without friction alone"):
        list(validate(tmp_path / "rest.yaml"))


AT_REST = """
cqrun: 1
job: rest
world: {size: [0.1, 0.1], dx: 0.01, gravity: [0, -9.81]}
path: {boundaries.clamp.sticky.rotation.0: [0, 0.1]}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.05], size: [0.03, 0.02]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {neo_hookean: {youngs_modulus: 2.0e4, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.03, 0.1]}}, rotation: [0]}}
"""
