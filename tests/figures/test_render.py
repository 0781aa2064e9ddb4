"""Movies and stills of a run: what they show, and what is said where they cannot be made."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from made_runs import DURATION, YOUNG, plane_scene, write_result, write_run, write_trajectory
from PIL import Image

from cqrun.build.particles import sample
from cqrun.errors import MissingExtra, Stopped, UsageError
from cqrun.figures import movie, solid
from cqrun.figures.colours import colours
from cqrun.figures.render import Wanted, followed_particles, render, set_stage, shown_frames, stamp
from cqrun.figures.run_data import TRAJECTORY, read_run
from cqrun.figures.scenery import goals, plot_goals
from cqrun.figures.style import GROUND, TRUTH, new_figure, styled
from cqrun.figures.views import PLANE
from cqrun.running.reporter import Silent
from cqrun.scene.load import load_scene
from cqrun.store.frames import Frames
from cqrun.store.trajectory import TrajectoryWriter

needs_pyvista = pytest.mark.skipif(importlib.util.find_spec("pyvista") is None, reason="the extra viz3d is absent")
needs_ffmpeg = pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="no extra video")

LEFT = {"box": {"corner": [0, 0], "size": [0.045, 0.1]}}
MUSCLE = {"muscle": {"body": "a", "region": LEFT, "axis": [1, 0], "strength": 1}}


def moving(out, scene, *, frames=4, dim=2, field_v=True):
    """Return a run whose particles move by 1 mm to the right a frame."""
    run = write_run(out, scene, job="simulate", status="done")
    particles = sample(read_run(run).scene)
    bodies = {name: particles.of(name) for name in particles.names}
    fields = {"v": (dim,)} if field_v else {}
    with TrajectoryWriter(run / TRAJECTORY, frames, bodies, dim, fields, {}) as writer:
        for k in range(frames):
            x = particles.x.copy()
            x[:, 0] += 1e-3 * k
            extra = {"v": np.full_like(x, 0.3)} if field_v else {}
            writer.write(k, 0.1 * k, x=x, step=np.asarray(10 * k), **extra)
    return run


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    actuators = {"pull": MUSCLE}
    goals = {"target": {"position": [0.19, 0.09]}}
    scene = plane_scene({}, actuators=actuators, activation={"signals": {"pull": [0.25, -0.5]}}, goals=goals)
    return moving(tmp_path_factory.mktemp("plane"), scene)


def block(**more):
    """Return a 3D scene of one block on a floor."""
    material = {"density": 1000.0, "elastic": {"neo_hookean": {"youngs_modulus": 2e5, "poissons_ratio": 0.4}}}
    cube = {"box": {"corner": [0.02, 0.02, 0.0], "size": [0.03, 0.02, 0.02]}}
    return {
        "cqrun": 1,
        "world": {"size": [0.1] * 3, "dx": 0.01, "gravity": [0, 0, -9.81]},
        "bodies": {"a": {"shape": cube, "particles_per_cell": 8, "material": material}},
        "boundaries": {"floor": {"sticky": {"face": "z_min"}}},
        "time": {"duration": DURATION, "control_step": 0.01, "substeps": 10},
    } | more


def opened(path):
    """Return a picture's colours (h, w, 3)."""
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def near(picture, colour):
    """Return how many pixels of a picture (h, w, 3) have nearly a colour (#rrggbb): a GIF has 255 for all of them."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(picture - rgb).max(axis=2) < 16).sum())


# --- what is shown ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wanted", "expected"),
    [
        (Wanted("gif"), [0, 1, 2, 3, 4, 5, 6]),
        (Wanted("mp4", every=3), [0, 3, 6]),
        (Wanted("png"), [6]),
        (Wanted("stills", count=3), [0, 3, 6]),
        (Wanted("onion", count=4), [0, 2, 4, 6]),
    ],
)
def test_frames_shown(wanted, expected):
    assert shown_frames(7, wanted) == expected


def test_more_stills_than_frames_and_no_frame_at_all():
    with pytest.raises(UsageError, match="--stills 8: the trajectory has only 7 frames"):
        shown_frames(7, Wanted("stills", count=8))
    with pytest.raises(UsageError, match="no frame in it yet"):
        shown_frames(0, Wanted())


def test_times_have_the_digits_that_tell_frames_apart(plane):
    with Frames(plane / TRAJECTORY) as frames:
        assert [stamp(frames, k) for k in range(4)] == ["0.0", "0.1", "0.2", "0.3"]


def test_the_window_holds_bodies_goal_and_trail(plane):
    with Frames(plane / TRAJECTORY) as frames:
        stage = set_stage(read_run(plane), frames, [0, 3], Wanted("onion", count=2))
        first, last = (frames.read("x", k) for k in (0, 3))
    low, high = stage.corners
    assert (low < first.min(axis=0)).all()
    assert (high > last.max(axis=0)).all()
    assert (high > [0.19, 0.09]).all()
    np.testing.assert_array_equal(stage.trails.frames, [0, 1, 2, 3])
    np.testing.assert_allclose(stage.trails.paths["a"][:, 0] - first[: len(first) // 2, 0].mean(), 1e-3 * np.arange(4))


def test_a_goal_is_where_this_run_drew_it_else_a_range():
    scene = load_scene(plane_scene({}, goals={"there": {"position": [0.1, 0.08], "spread": [0.03, 0.0]}}))
    (ranged,) = goals(scene)
    assert (ranged.name, ranged.position.tolist(), ranged.spread.tolist()) == ("there", [0.1, 0.08], [0.03, 0.0])
    (drawn,) = goals(scene, {"goals": {"there": [0.12, 0.08]}})
    assert (drawn.position.tolist(), drawn.spread.tolist()) == ([0.12, 0.08], [0.0, 0.0])
    with styled():
        axes = new_figure(3, 3).add_subplot()
        plot_goals(axes, [ranged, drawn], PLANE, 10.0)
    (box,) = axes.patches  # of the one that has a range
    np.testing.assert_allclose([box.get_x(), box.get_y(), box.get_width(), box.get_height()], [0.7, 0.8, 0.6, 0.0])


def test_a_course_is_marked_place_by_place():
    scene = load_scene(plane_scene({}))
    (wave,) = goals(scene, {"goals": {}, "courses": {"wave": [[0.1, 0.08], [0.12, 0.07], [0.14, 0.06]]}})
    with styled():
        axes = new_figure(3, 3).add_subplot()
        plot_goals(axes, [wave], PLANE, 10.0)
    end, course = axes.lines
    np.testing.assert_allclose(course.get_xydata(), [[1.0, 0.8], [1.2, 0.7], [1.4, 0.6]])
    np.testing.assert_allclose(end.get_xydata(), [[1.4, 0.6]])


def test_who_leaves_a_trail(plane):
    run = read_run(plane)
    x = sample(run.scene).x
    with Frames(plane / TRAJECTORY) as frames:
        assert list(followed_particles(run, frames, None)) == ["a", "b"]
        assert followed_particles(run, frames, "none") == {}
        (left,) = followed_particles(run, frames, "left").values()
        assert (x[left][:, 0] < 0.045).all()
        assert len(left) > 0
        assert list(followed_particles(run, frames, "a.right")) == ["a.right"]
        with pytest.raises(UsageError, match=r"--trail a\.lift: no body or .* \(did you mean 'a\.left'"):
            followed_particles(run, frames, "a.lift")


# --- colours ------------------------------------------------------------------------------------------------


def scheme(run, quantity, shown=(0, 1, 2, 3)):
    with Frames(run / TRAJECTORY) as frames:
        name, found = colours(quantity, read_run(run), frames, shown)
        return name, found, [found.values(k) for k in range(len(frames))]


def test_activation_comes_from_the_scene_where_it_is_not_stored(plane):
    x = sample(read_run(plane).scene).x
    name, found, values = scheme(plane, None)
    assert (name, found.label, found.low, found.high) == ("activation", "activation", -0.5, 0.5)
    driven = np.isfinite(values[0])
    np.testing.assert_array_equal(driven, x[:, 0] < 0.045)
    # steps 0, 10, 20 of 40 lie in the first half of the run, 30 in the second
    np.testing.assert_allclose([v[driven].mean() for v in values], [0.25, 0.25, 0.25, -0.5])
    assert [float(np.ptp(v[driven])) for v in values] == [0.0] * 4


def test_displacement_and_speed(plane):
    _, found, values = scheme(plane, "displacement")
    assert found.label == "displacement (mm)"
    np.testing.assert_allclose([v.mean() for v in values], [0, 1, 2, 3], atol=1e-9)
    _, found, values = scheme(plane, "velocity")
    assert (found.label, found.high) == ("speed (m/s)", pytest.approx(0.3 * np.sqrt(2)))


def test_strain_is_that_of_the_deformation(tmp_path):
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="done")
    rest = np.stack(np.meshgrid(np.arange(6.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    F = np.array([[1.2, 0.3], [0.0, 0.9]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    write_trajectory(run, np.stack([rest, rest @ turn.T, rest @ F.T]), np.array([0.0, 0.1, 0.2]))
    E = 0.5 * (F.T @ F - np.eye(2))
    values = scheme(run, "strain", (0, 1, 2))[2]
    expected = [0.0, 0.0, np.linalg.norm(E)]
    np.testing.assert_allclose(values, np.repeat(np.array(expected)[:, None], 30, axis=1), atol=1e-12)


def test_stiffness_is_what_was_found(tmp_path):
    run = moving(tmp_path, plane_scene({}))
    _, found, values = scheme(run, "stiffness")
    assert (found.label, found.low, found.high) == ("Young's modulus (kPa)", 0.0, 400.0)
    write_result(run, {f"bodies.b.{YOUNG}": {"value": 3e5}}, None)
    with Frames(run / TRAJECTORY) as frames:
        bodies = frames.bodies
    _, found, values = scheme(run, "stiffness")
    assert (found.low, found.high) == (pytest.approx(200), pytest.approx(300))
    np.testing.assert_allclose(values[0][bodies["a"]], 200)
    np.testing.assert_allclose(values[0][bodies["b"]], 300)


@pytest.mark.parametrize(
    ("quantity", "message"),
    [
        ("activation", "--color activation: the scene of this run has no actuators"),
        ("velocity", r"--color velocity: .* holds no field v; displacement and strain can be shown of every run"),
    ],
)
def test_what_is_not_there_is_told_by_name(tmp_path, quantity, message):
    with pytest.raises(UsageError, match=message):
        scheme(moving(tmp_path, plane_scene({}), field_v=False), quantity)


def test_a_scene_that_is_not_the_trajectorys(tmp_path):
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="done")
    write_trajectory(run, np.zeros((1, 3, 2)), np.array([0.0]))
    with pytest.raises(UsageError, match="its particles are not those of"):
        scheme(run, "stiffness", (0,))


# --- files --------------------------------------------------------------------------------------------------


def test_a_gif_shows_the_motion(plane):
    (path,) = render(plane, Wanted("gif", fps=20))
    assert path == plane / "figures" / "motion_activation.gif"
    with Image.open(path) as gif:
        assert (gif.n_frames, gif.info["duration"], gif.info["loop"]) == (4, 50, 0)
        pictures = []
        for k in range(4):
            gif.seek(k)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    assert all(near(picture, TRUTH) > 20 for picture in pictures)  # the goal
    assert all(near(picture, GROUND) > 1000 for picture in pictures)  # the clamp
    assert all((np.abs(a - b).max(axis=2) > 60).sum() > 200 for a, b in pairwise(pictures))
    assert (pictures[0][0, 0] == 255).all()


def test_stills_and_onion_skins(plane, tmp_path):
    paths = render(plane, Wanted("stills", count=2, output=tmp_path / "deep" / "a.png"))
    assert [path.name for path in paths] == ["a_1.png", "a_2.png"]
    (onion,) = render(plane, Wanted("onion", count=2, color="displacement", trail="none"))
    assert onion == plane / "figures" / "onion_displacement.png"
    (last,) = render(plane, Wanted("png", color="displacement", trail="none"))
    two, one = opened(onion), opened(last)
    pale = np.array([0.78 + 0.22 * c for c in (0.267, 0.005, 0.329)]) * 255  # the map's beginning, mixed with white
    assert (np.abs(two - pale).max(axis=2) < 6).sum() > 500
    assert (np.abs(one - pale).max(axis=2) < 6).sum() < 50


@needs_ffmpeg
def test_an_mp4_holds_every_frame(plane, tmp_path):
    (path,) = render(plane, Wanted("mp4", fps=10, output=tmp_path / "a.mp4"))
    raw = subprocess.run(
        [movie.ffmpeg(), "-loglevel", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
        capture_output=True, check=True,
    ).stdout  # fmt: skip
    still = opened(render(plane, Wanted("gif", output=tmp_path / "a.gif"))[0])
    assert len(raw) == 4 * still.size
    first = np.frombuffer(raw, np.uint8)[: still.size].reshape(still.shape)
    assert np.abs(first.astype(int) - still).mean() < 3
    assert list(tmp_path.glob(".*")) == []


def test_a_run_that_is_being_written_is_drawn_as_far_as_it_is(tmp_path):
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="running")
    x = sample(read_run(run).scene).x
    writer = TrajectoryWriter(run / TRAJECTORY, 9, {"a": slice(0, 40), "b": slice(40, 80)}, 2, {}, {})
    writer.write(0, 0.0, x=x)
    writer.write(1, 0.1, x=x + 1e-3)
    writer.abandon()
    (path,) = render(run, Wanted("gif"))
    with Image.open(path) as gif:
        assert gif.n_frames == 2


class Asked(Silent):
    """A reporter that asks to stop after the second picture."""

    def advance(self, done: int, total: int, text: str) -> None:
        if done == 2:
            self.stop.ask()


@pytest.mark.parametrize("kind", ["gif", pytest.param("mp4", marks=needs_ffmpeg)])
def test_one_that_is_stopped_leaves_nothing(plane, tmp_path, kind):
    with pytest.raises(Stopped, match="no picture was written"):
        render(plane, Wanted(kind, output=tmp_path / f"a.{kind}"), Asked())
    assert list(tmp_path.iterdir()) == []


def test_trouble_is_told(plane, tmp_path, monkeypatch):
    with pytest.raises(UsageError, match="--view top: the world of this run has two dimensions"):
        render(plane, Wanted(view="top"))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtra, match=r"--mp4 needs imageio-ffmpeg.*pip install 'cqrun\[video\]'"):
        render(plane, Wanted("mp4"))
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="running")
    with pytest.raises(UsageError, match="nothing to draw before the first frame"):
        render(run, Wanted())
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be made"):
        render(plane, Wanted(output=tmp_path / "file" / "a.gif"))


# --- three dimensions ---------------------------------------------------------------------------------------


def test_without_pyvista_the_extra_is_named(tmp_path, monkeypatch):
    run = moving(tmp_path, block(), dim=3)
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(MissingExtra, match=r"needs pyvista .*pip install 'cqrun\[viz3d\]'"):
        render(run, Wanted("png"))


@needs_pyvista
def test_without_anything_that_draws_it_is_told(tmp_path, monkeypatch):
    run = moving(tmp_path, block(), dim=3)
    monkeypatch.setattr(solid, "WITHOUT_DISPLAY", ("libnone.so.1",))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(UsageError, match=r"there is no display, and none of libnone\.so\.1"):
        render(run, Wanted("png"))


@needs_pyvista
def test_bodies_of_three_dimensions_move(tmp_path):
    run = moving(tmp_path, block(), dim=3, frames=3)
    try:
        solid.require_pyvista()
    except UsageError as error:
        pytest.skip(str(error))
    (path,) = render(run, Wanted("gif", color="displacement"))
    with Image.open(path) as gif:
        pictures = []
        for k in range(3):
            gif.seek(k)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    assert all((np.abs(a - b).max(axis=2) > 40).sum() > 500 for a, b in pairwise(pictures))
    (side,) = render(run, Wanted("png", color="displacement", view="side", output=tmp_path / "side.png"))
    rgb = opened(side)
    assert near(rgb, GROUND) > 1000  # the floor below it
    # all have moved as far, so all have the last colour, a bright yellow but for the shading of spheres
    yellow = (rgb[..., 0] > 120) & (rgb[..., 1] > 110) & (rgb[..., 2] < 90)
    wide, tall = (np.ptp(np.flatnonzero(yellow.any(axis=axis))) for axis in (0, 1))
    assert wide / tall == pytest.approx(30 / 20, rel=0.15)
