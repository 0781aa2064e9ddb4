"""design.png: quantities that the design varies between particles."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_hex
from small_beam import changed, result_of
from small_finger import FINGER

import cqrun
from cqrun.build.particles import sample
from cqrun.figures.convergence import unknown_curves
from cqrun.figures.design import designed_quantities, draw_design, draw_shape, has_new_shape
from cqrun.figures.draw import draw_run
from cqrun.figures.render import RenderOptions, render
from cqrun.figures.run_data import read_run
from cqrun.figures.style import AMOUNT_MAP, PASSIVE
from cqrun.jobs.control import run_codesign
from cqrun.running.reporter import Silent

E, RHO = (f"bodies.finger.material.{name}" for name in ("elastic.fixed_corotated.youngs_modulus", "density"))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return a run that has designed the stiffness of every particle, and one density."""
    path = tmp_path_factory.mktemp("design") / "finger.yaml"
    unknowns = f"unknowns:\n  {E}: {{bounds: [5, 20], per: particle}}\n  {RHO}: {{bounds: [0.5, 2]}}\n"
    path.write_text(FINGER.replace("job: control", "job: codesign") + unknowns)
    changed(path, "duration: 0.1", "duration: 0.04")
    return run_codesign(path, [], path.parent / "out", threads=1)


def test_quantities_that_vary_between_particles_are_shown(run):
    shown = designed_quantities(read_run(run))
    assert list(shown) == ["stiffness"]  # the density is one number
    np.testing.assert_array_equal(shown["stiffness"], result_of(run)["unknowns"][E]["value"])


def test_a_body_that_is_not_designed_has_no_colour(run, tmp_path):
    """Otherwise its other stiffness would stretch the colour range, and the designed body would look uniform."""
    ball = "{shape: {box: {corner: [0.7, 0.2], size: [0.1, 0.1]}}, particles_per_cell: 4, material: {density: 1, "
    ball += "elastic: {fixed_corotated: {youngs_modulus: 100, poissons_ratio: 0.3}}}}"
    more = [f"bodies.ball={ball}", "optimizer.adam.max_iterations=1"]
    both = run_codesign(run / "scene.yaml", more, tmp_path, threads=1)
    data = read_run(both)
    values = designed_quantities(data)["stiffness"]
    assert np.isnan(values).sum() == 4
    figure = draw_design(data, {"stiffness": values})
    assert figure.axes[-1].get_ylim()[1] < 21
    seen = {to_hex(colour) for colour in figure.axes[0].collections[-1].get_facecolor()}
    assert PASSIVE.lower() in seen


def test_the_body_is_drawn_at_rest_and_moved(run):
    data = read_run(run)
    figure = draw_design(data, designed_quantities(data))
    panels = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title().split(" = ")[0] for axes in panels] == ["at rest", "t"]
    values = np.sort(result_of(run)["unknowns"][E]["value"])
    ends = colormaps[AMOUNT_MAP]([0.0, 1.0])
    for axes in panels:
        seen = axes.collections[-1].get_facecolor()
        assert all((abs(seen - end).max(axis=1) < 1e-12).any() for end in ends)
        assert len(np.unique(seen, axis=0)) > 5
    assert figure.axes[-1].get_ylim() == pytest.approx((values[0], values[-1]))
    assert figure.axes[-1].get_ylabel() == "Young's modulus (Pa)"
    assert run / "figures" / "design.png" in draw_run(run)


def test_a_new_shape_is_drawn_next_to_the_old_one(run, tmp_path):
    """The height of each body follows the height of the finger's tip."""
    path = tmp_path / "finger.yaml"
    size = "bodies.finger.parts.tip.box.size.1"
    unknown = f"unknowns:\n  {size}: {{bounds: [0.6, 1.0], initial: 0.8}}\n"
    path.write_text(FINGER.replace("job: control", "job: codesign") + unknown)
    changed(path, "duration: 0.1", "duration: 0.04")
    shaped = run_codesign(path, [], tmp_path / "out", threads=1)
    data = read_run(shaped)
    assert designed_quantities(data) == {}
    assert (has_new_shape(data), has_new_shape(read_run(run))) == (True, False)
    panels = draw_shape(data).axes
    assert [axes.get_title() for axes in panels] == ["before", "designed"]
    tops = [max(float(c.get_offsets()[:, 1].max()) for c in axes.collections if len(c.get_offsets()) > 9)
            for axes in panels]  # fmt: skip
    designed = result_of(shaped)["unknowns"][size]["value"]
    assert abs(designed - 0.8) > 1e-3
    # the uppermost of four particles along the tip, whose lower edge is at 0.6 m
    assert tops == pytest.approx([0.6 + 0.2 * height * 7 / 8 for height in (0.8, designed)], abs=1e-6)
    assert shaped / "figures" / "shape.png" in draw_run(shaped)


def test_a_control_run_has_no_design(run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(run, copy, ignore=shutil.ignore_patterns("figures"))
    record = json.loads((copy / "run.json").read_text())
    (copy / "run.json").write_text(json.dumps(record | {"job": "control"}))
    assert {path.stem for path in draw_run(copy)} == {"convergence", "bodies", "overview"}


def test_the_weights_of_a_muscle_are_shown(tmp_path):
    path, weight = tmp_path / "finger.yaml", "actuators.muscle.muscle.weight"
    unknown = f"unknowns:\n  {weight}: {{bounds: [0, 1], initial: 0.5, per: particle}}\n"
    path.write_text(FINGER.replace("job: control", "job: codesign") + unknown)
    run = run_codesign(path, [], tmp_path / "out", threads=1)
    (shown,) = (data := designed_quantities(read_run(run))).values()
    assert list(data) == ["weight"]
    tip = sample(read_run(run).scene).groups("finger")["tip"]
    assert not shown[tip].any()  # the muscles lie in the other two groups
    others = np.setdiff1d(np.arange(len(shown)), tip)
    np.testing.assert_array_equal(shown[others], np.array(result_of(run)["unknowns"][weight]["value"])[others])
    assert np.ptp(shown[others]) > 1e-3
    figure = draw_design(read_run(run), data)
    assert figure.axes[-1].get_ylabel() == "share of the actuator's strength"
    drawn = render(run, RenderOptions("png", 1, "weight", 25.0, 1, None, None, tmp_path / "w.png"), Silent())
    assert drawn == [tmp_path / "w.png"]


def test_muscle_weights_per_group_are_learned_and_drawn(tmp_path):
    """Key paths of actuators contain no body, so the names of the groups must come from the actuator's body."""
    path, weight = tmp_path / "finger.yaml", "actuators.muscle.muscle.weight"
    unknown = f"unknowns:\n  {weight}: {{bounds: [0, 1], initial: 0.5, per: group}}\n"
    path.write_text(FINGER.replace("job: control", "job: codesign") + unknown)
    problem = cqrun.load(path)
    _, gradient, _ = problem.value_and_grad(problem.params)
    groups = len(problem.scene.bodies["finger"].group_names)
    assert gradient[weight].shape == problem.params[weight].shape == (groups,)
    run = run_codesign(path, [], tmp_path / "out", threads=1)
    (curve,) = unknown_curves(read_run(run))
    assert curve.names == problem.scene.bodies["finger"].group_names
    assert draw_run(run)
