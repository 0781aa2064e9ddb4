"""Colours of bodies: the quantities that they show, the same in every picture of a run, and lines around bodies."""

from __future__ import annotations

import numpy as np
import pytest
from made_motion import moving, pulled
from made_runs import YOUNG, plane_scene, write_result, write_run, write_trajectory

from cqrun.build.particles import sample
from cqrun.errors import UsageError
from cqrun.figures.bodies import draw_bodies
from cqrun.figures.colours import colours
from cqrun.figures.dots import DARK, Dots
from cqrun.figures.render import RenderOptions, set_stage
from cqrun.figures.run_data import TRAJECTORY, read_run
from cqrun.figures.style import styled
from cqrun.store.frames import Frames


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    return pulled(tmp_path_factory.mktemp("plane"))


def scheme(run, quantity):
    with Frames(run / TRAJECTORY) as frames:
        name, result = colours(quantity, read_run(run), frames)
        return name, result, [result.values(k) for k in range(len(frames))]


def test_activation_is_computed_from_the_scene_if_it_is_not_stored(plane):
    x = sample(read_run(plane).scene).x
    name, shown, values = scheme(plane, None)
    assert (name, shown.label, shown.low, shown.high) == ("activation", "activation", -0.5, 0.5)
    driven = np.isfinite(values[0])
    np.testing.assert_array_equal(driven, x[:, 0] < 0.045)
    # steps 0, 10, 20 of 40 lie in the first half of the run, 30 in the second
    np.testing.assert_allclose([v[driven].mean() for v in values], [0.25, 0.25, 0.25, -0.5])
    assert [float(np.ptp(v[driven])) for v in values] == [0.0] * 4


def test_displacement_and_speed(plane):
    _, shown, values = scheme(plane, "displacement")
    assert shown.label == "displacement (mm)"
    np.testing.assert_allclose([v.mean() for v in values], [0, 1, 2, 3], atol=1e-9)
    _, shown, values = scheme(plane, "velocity")
    assert (shown.label, shown.high) == ("speed (m/s)", pytest.approx(0.3 * np.sqrt(2)))


def test_a_body_has_the_same_colours_in_every_picture(plane):
    """Film, several instants and bodies.png show one quantity with one range, and bodies have a darker line."""
    run = read_run(plane)
    with Frames(plane / TRAJECTORY) as frames, styled():
        film, onion = (set_stage(run, frames, shown, RenderOptions()) for shown in ([0, 1, 2, 3], [0, 2]))
        figure = draw_bodies(run)
        for axes, frame in zip(figure.axes[:3], (0, 2, 3), strict=True):
            dots, rgb = axes.collections[-1], film.colours.rgb(frame)
            np.testing.assert_array_equal(onion.colours.rgb(frame), rgb)
            np.testing.assert_allclose(dots.get_facecolor()[-len(film.dots.source) :, :3], rgb[film.dots.source])
            line = np.array(dots.get_linewidths()) > 0
            np.testing.assert_allclose(dots.get_facecolor()[line, :3], DARK * rgb[film.dots.source[film.dots.rim]])
        assert figure.axes[3].get_ylabel() == film.colours.label == "activation"


def test_the_rim_of_a_body_is_its_outer_row_of_dots():
    x = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(-1, 2)
    dots = Dots.of(x, {"a": slice(0, 63)})
    outer = (x[:, 0] % 8 == 0) | (x[:, 1] % 6 == 0)
    assert set(np.flatnonzero(outer)) <= set(dots.rim)
    inner = (abs(x[:, 0] - 4) < 2) & (abs(x[:, 1] - 3) < 1)
    assert not set(np.flatnonzero(inner)) & set(dots.rim)
    few = dots.thinned(x, {"a": slice(0, 63)}, 20)
    assert 0 < len(few.rim) <= len(few.size)
    assert few.rim.max() < len(few.size)
    assert Dots.of(np.random.default_rng(0).random((50, 3)), {"a": slice(0, 50)}).rim.size == 0


def test_strain_is_computed_from_the_deformation(tmp_path):
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="done")
    rest = np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    F = np.array([[1.2, 0.3], [0.0, 0.9]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    write_trajectory(run, np.stack([rest, rest @ turn.T, rest @ F.T]), np.array([0.0, 0.1, 0.2]))
    E = 0.5 * (F.T @ F - np.eye(2))
    values = scheme(run, "strain")[2]
    expected = [0.0, 0.0, np.linalg.norm(E)]
    np.testing.assert_allclose(values, np.repeat(np.array(expected)[:, None], 30, axis=1), atol=1e-12)


def test_stiffness_is_the_identified_one(tmp_path):
    run = moving(tmp_path, plane_scene({}))
    _, shown, values = scheme(run, "stiffness")
    assert (shown.label, shown.low, shown.high) == ("Young's modulus (kPa)", 0.0, 400.0)
    write_result(run, {f"bodies.b.{YOUNG}": {"value": 3e5}}, None)
    with Frames(run / TRAJECTORY) as frames:
        bodies = frames.bodies
    _, shown, values = scheme(run, "stiffness")
    assert (shown.low, shown.high) == (pytest.approx(200), pytest.approx(300))
    np.testing.assert_allclose(values[0][bodies["a"]], 200)
    np.testing.assert_allclose(values[0][bodies["b"]], 300)


@pytest.mark.parametrize(
    ("quantity", "message"),
    [
        ("activation", "--color activation: the scene of this run has no actuators"),
        ("velocity", r"--color velocity: .* has no field v; displacement and strain can be shown for every run"),
    ],
)
def test_the_error_names_a_missing_quantity(tmp_path, quantity, message):
    with pytest.raises(UsageError, match=message):
        scheme(moving(tmp_path, plane_scene({}), field_v=False), quantity)


def test_a_scene_with_other_particles_than_the_trajectory_is_refused(tmp_path):
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="done")
    write_trajectory(run, np.zeros((1, 3, 2)), np.array([0.0]))
    with pytest.raises(UsageError, match="its particles are not those of"):
        scheme(run, "stiffness")
