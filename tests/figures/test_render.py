"""Movies and stills of a run: what they show, and the errors if they cannot be made."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from made_motion import moving, pulled
from made_runs import DURATION, plane_scene, write_run
from PIL import Image

from cqrun.build.particles import sample
from cqrun.errors import MissingExtra, Stopped, UsageError
from cqrun.figures import movie, solid
from cqrun.figures.picture import Picture
from cqrun.figures.render import RenderOptions, followed_particles, render, set_stage, shown_frames, stamp
from cqrun.figures.run_data import TRAJECTORY, read_run
from cqrun.figures.scenery import goals, plot_goals
from cqrun.figures.style import GROUND, TRUTH, new_figure, styled
from cqrun.figures.views import PLANE
from cqrun.running.reporter import Silent
from cqrun.scene.load import load_scene
from cqrun.store.frames import Frames
from cqrun.store.trajectory import TrajectoryWriter

needs_pyvista = pytest.mark.skipif(
    importlib.util.find_spec("pyvista") is None, reason="the extra viz3d is not installed"
)
needs_ffmpeg = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="the extra video is not installed"
)


@pytest.fixture(scope="module")
def plane(tmp_path_factory):
    return pulled(tmp_path_factory.mktemp("plane"))


class NoBodies:
    """Bodies in 3D that need no renderer, because nothing of them is seen."""

    def __init__(self, *words):
        self.blank = np.zeros((*words[-1][::-1], 4))

    def paint(self, layers):
        return self.blank

    def close(self):
        """Do nothing: there is nothing to release."""


@pytest.mark.parametrize("dim", [2, 3])
def test_a_film_draws_its_axes_once_and_looks_as_if_all_were_drawn(plane, dim, tmp_path, monkeypatch):
    monkeypatch.setattr("cqrun.figures.picture.SolidBodies", NoBodies)
    folder = plane if dim == 2 else moving(tmp_path, block(), dim=3)
    run, shown = read_run(folder), [0, 1, 2, 3]
    with Frames(folder / TRAJECTORY) as frames, styled():
        stage = set_stage(run, frames, shown, RenderOptions())
        layers = [(frames.read("x", frame), stage.colours.rgb(frame)) for frame in shown]
        with Picture(stage, 1, 60.0) as picture:
            drawn = []
            picture.axes.xaxis.draw = drawn.append
            pictures = [picture.show([layer], f"t = {frame} s", frame) for frame, layer in enumerate(layers)]
            assert drawn == []
        with Picture(stage, 1, 60.0) as picture:
            picture.show([layers[3]], "t = 3 s", 3)
            for artist in picture.axes.get_children():
                artist.set_animated(False)
            picture.figure.canvas.draw()
            whole = np.asarray(picture.figure.canvas.buffer_rgba())[..., :3]
    np.testing.assert_array_equal(pictures[3], whole)
    assert (pictures[0] != pictures[3]).any()


def block(**more):
    """Return a 3D scene with one block on a floor."""
    material = {"density": 1000.0, "elastic": {"neo_hookean": {"youngs_modulus": 2e5, "poissons_ratio": 0.4}}}
    cube = {"box": {"corner": [0.02, 0.02, 0.0], "size": [0.03, 0.02, 0.02]}}
    return {
        "cqrun": 1,
        "world": {"size": [0.1] * 3, "dx": 0.01, "gravity": [0, 0, -9.81], "frame": "updated"},
        "bodies": {"a": {"shape": cube, "particles_per_cell": 8, "material": material}},
        "boundaries": {"floor": {"sticky": {"face": "z_min"}}},
        "time": {"duration": DURATION, "control_step": 0.01, "substeps": 10},
    } | more


def opened(path):
    """Return a picture's colours (h, w, 3)."""
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)


def near(picture, colour):
    """Return how many pixels of a picture (h, w, 3) have nearly a colour (#rrggbb); a GIF has only 255 colours."""
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    return int((np.abs(picture - rgb).max(axis=2) < 16).sum())


# --- what is shown ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (RenderOptions("gif"), [0, 1, 2, 3, 4, 5, 6]),
        (RenderOptions("mp4", every=3), [0, 3, 6]),
        (RenderOptions("png"), [6]),
        (RenderOptions("stills", count=3), [0, 3, 6]),
        (RenderOptions("onion", count=4), [0, 2, 4, 6]),
    ],
)
def test_frames_shown(options, expected):
    assert shown_frames(7, options) == expected


def test_too_few_frames_are_refused():
    with pytest.raises(UsageError, match="--stills 8: the trajectory has only 7 frames"):
        shown_frames(7, RenderOptions("stills", count=8))
    with pytest.raises(UsageError, match="no frame in it yet"):
        shown_frames(0, RenderOptions())


def test_times_have_enough_digits_to_distinguish_frames(plane):
    with Frames(plane / TRAJECTORY) as frames:
        assert [stamp(frames, k) for k in range(4)] == ["0.0", "0.1", "0.2", "0.3"]


def test_the_window_contains_bodies_goal_and_trail(plane):
    with Frames(plane / TRAJECTORY) as frames:
        stage = set_stage(read_run(plane), frames, [0, 3], RenderOptions("onion", count=2))
        first, last = (frames.read("x", k) for k in (0, 3))
    low, high = stage.corners
    assert (low < first.min(axis=0)).all()
    assert (high > last.max(axis=0)).all()
    assert (high > [0.19, 0.09]).all()
    np.testing.assert_array_equal(stage.trails.frames, [0, 1, 2, 3])
    np.testing.assert_allclose(stage.trails.paths["a"][:, 0] - first[: len(first) // 2, 0].mean(), 1e-3 * np.arange(4))


def test_a_goal_is_shown_at_its_drawn_position_or_as_a_range():
    scene = load_scene(plane_scene({}, goals={"there": {"position": [0.1, 0.08], "spread": [0.03, 0.0]}}))
    (ranged,) = goals(scene)
    assert (ranged.name, ranged.position.tolist(), ranged.spread.tolist()) == ("there", [0.1, 0.08], [0.03, 0.0])
    (drawn,) = goals(scene, {"goals": {"there": [0.12, 0.08]}})
    assert (drawn.position.tolist(), drawn.spread.tolist()) == ([0.12, 0.08], [0.0, 0.0])
    with styled():
        axes = new_figure(3, 3).add_subplot()
        plot_goals(axes, [ranged, drawn], PLANE, 10.0)
    (box,) = axes.patches  # only for the goal with a range
    np.testing.assert_allclose([box.get_x(), box.get_y(), box.get_width(), box.get_height()], [0.7, 0.8, 0.6, 0.0])


def test_every_position_of_a_course_is_marked():
    scene = load_scene(plane_scene({}))
    (wave,) = goals(scene, {"goals": {}, "courses": {"wave": [[0.1, 0.08], [0.12, 0.07], [0.14, 0.06]]}})
    with styled():
        axes = new_figure(3, 3).add_subplot()
        plot_goals(axes, [wave], PLANE, 10.0)
    end, course = axes.lines
    np.testing.assert_allclose(course.get_xydata(), [[1.0, 0.8], [1.2, 0.7], [1.4, 0.6]])
    np.testing.assert_allclose(end.get_xydata(), [[1.4, 0.6]])


def test_bodies_and_groups_can_leave_a_trail(plane):
    run = read_run(plane)
    x = sample(run.scene).x
    with Frames(plane / TRAJECTORY) as frames:
        assert list(followed_particles(run, frames, None)) == ["a", "b"]
        assert followed_particles(run, frames, "none") == {}
        (left,) = followed_particles(run, frames, "left").values()
        assert (x[left][:, 0] < 0.045).all()
        assert len(left) > 0
        assert list(followed_particles(run, frames, "a.right")) == ["a.right"]
        with pytest.raises(
            UsageError, match=r"--trail a\.lift: no body or group has this name \(did you mean 'a\.left'"
        ):
            followed_particles(run, frames, "a.lift")


def test_the_group_that_should_reach_a_goal_leaves_the_trail(tmp_path):
    """A goal is for the tip; the centroid of the whole body goes elsewhere."""
    there = {"reach": {"body": "a", "group": "right", "goal": "target"}}
    goals = {"target": {"position": [0.19, 0.09]}}
    still = {"of": {"reach": {"body": "a", "group": "left", "position": [0.03, 0.06]}}, "at_most": 1e-4}
    own = {"goals": goals, "data": None}
    for more, wanted in (
        ({"objective": {"there": there}}, ["a.right", "b"]),
        ({"objective": {"there": there, "again": there}}, ["a.right", "b"]),
        ({"objective": {"there": there}, "constraints": {"still": still}}, ["a.right", "a.left", "b"]),
        ({"objective": {"there": {"reach": {"body": "a", "goal": "target"}}}}, ["a", "b"]),
    ):
        run = read_run(moving(tmp_path / str(len(list(tmp_path.iterdir()))), plane_scene({}, **own, **more)))
        groups = sample(run.scene).groups("a")
        with Frames(run.path / TRAJECTORY) as frames:
            followed = followed_particles(run, frames, None)
            assert list(followed) == wanted
            if "a.right" in followed:
                np.testing.assert_array_equal(followed["a.right"], groups["right"])
            assert list(followed_particles(run, frames, "a")) == ["a"]
            assert followed_particles(run, frames, "none") == {}


# --- files --------------------------------------------------------------------------------------------------


def test_a_gif_shows_the_motion(plane):
    (path,) = render(plane, RenderOptions("gif", fps=20))
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
    paths = render(plane, RenderOptions("stills", count=2, output=tmp_path / "deep" / "a.png"))
    assert [path.name for path in paths] == ["a_1.png", "a_2.png"]
    (onion,) = render(plane, RenderOptions("onion", count=2, color="displacement", trail="none"))
    assert onion == plane / "figures" / "onion_displacement.png"
    (last,) = render(plane, RenderOptions("png", color="displacement", trail="none"))
    instants, final = opened(onion), opened(last)
    pale = np.array([0.78 + 0.22 * c for c in (0.267, 0.005, 0.329)]) * 255  # the map's first colour, mixed with white
    assert (np.abs(instants - pale).max(axis=2) < 6).sum() > 500
    assert (np.abs(final - pale).max(axis=2) < 6).sum() < 50


@needs_ffmpeg
def test_an_mp4_contains_every_frame(plane, tmp_path):
    (path,) = render(plane, RenderOptions("mp4", fps=10, output=tmp_path / "a.mp4"))
    raw = subprocess.run(
        [movie.ffmpeg(), "-loglevel", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
        capture_output=True, check=True,
    ).stdout  # fmt: skip
    still = opened(render(plane, RenderOptions("gif", output=tmp_path / "a.gif"))[0])
    assert len(raw) == 4 * still.size
    first = np.frombuffer(raw, np.uint8)[: still.size].reshape(still.shape)
    assert np.abs(first.astype(int) - still).mean() < 3
    assert list(tmp_path.glob(".*")) == []


def test_an_incomplete_trajectory_is_drawn_as_far_as_possible(tmp_path):
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="running")
    x = sample(read_run(run).scene).x
    writer = TrajectoryWriter(run / TRAJECTORY, 9, {"a": slice(0, 40), "b": slice(40, 80)}, 2, {}, {})
    writer.write(0, 0.0, x=x)
    writer.write(1, 0.1, x=x + 1e-3)
    writer.abandon()
    (path,) = render(run, RenderOptions("gif"))
    with Image.open(path) as gif:
        assert gif.n_frames == 2


class StopsAtTwo(Silent):
    """A reporter that asks to stop after the second picture."""

    def advance(self, done: int, total: int, text: str) -> None:
        if done == 2:
            self.stop.ask()


@pytest.mark.parametrize("kind", ["gif", pytest.param("mp4", marks=needs_ffmpeg)])
def test_a_stopped_movie_leaves_no_file(plane, tmp_path, kind):
    with pytest.raises(Stopped, match="no picture was written"):
        render(plane, RenderOptions(kind, output=tmp_path / f"a.{kind}"), StopsAtTwo())
    assert list(tmp_path.iterdir()) == []


def test_errors_say_what_to_do(plane, tmp_path, monkeypatch):
    with pytest.raises(UsageError, match="--view top: the world of this run has two dimensions"):
        render(plane, RenderOptions(view="top"))
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtra, match=r"--mp4 needs imageio-ffmpeg.*pip install 'cqrun\[video\]'"):
        render(plane, RenderOptions("mp4"))
    run = write_run(tmp_path, plane_scene({}), job="simulate", status="running")
    with pytest.raises(UsageError, match="nothing to draw before the first frame"):
        render(run, RenderOptions())
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="cannot be made"):
        render(plane, RenderOptions(output=tmp_path / "file" / "a.gif"))


# --- three dimensions ---------------------------------------------------------------------------------------


def test_without_pyvista_the_error_names_the_extra(tmp_path, monkeypatch):
    run = moving(tmp_path, block(), dim=3)
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(MissingExtra, match=r"needs pyvista .*pip install 'cqrun\[viz3d\]'"):
        render(run, RenderOptions("png"))


@needs_pyvista
def test_without_a_display_or_its_replacements_there_is_an_error(tmp_path, monkeypatch):
    run = moving(tmp_path, block(), dim=3)
    monkeypatch.setattr(solid, "WITHOUT_DISPLAY", ("libnone.so.1",))
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(UsageError, match=r"there is no display, and none of libnone\.so\.1"):
        render(run, RenderOptions("png"))


@needs_pyvista
def test_bodies_in_3d_move(tmp_path):
    run = moving(tmp_path, block(), dim=3, frames=3)
    try:
        solid.require_pyvista()
    except UsageError as error:
        pytest.skip(str(error))
    (path,) = render(run, RenderOptions("gif", color="displacement"))
    with Image.open(path) as gif:
        pictures = []
        for k in range(3):
            gif.seek(k)
            pictures.append(np.asarray(gif.convert("RGB")).astype(int))
    assert all((np.abs(a - b).max(axis=2) > 40).sum() > 500 for a, b in pairwise(pictures))
    (side,) = render(run, RenderOptions("png", color="displacement", view="side", output=tmp_path / "side.png"))
    rgb = opened(side)
    assert near(rgb, GROUND) > 1000  # the floor below it
    # all particles have the same displacement, so all have the last colour, a bright yellow with shading
    yellow = (rgb[..., 0] > 120) & (rgb[..., 1] > 110) & (rgb[..., 2] < 90)
    wide, tall = (np.ptp(np.flatnonzero(yellow.any(axis=axis))) for axis in (0, 1))
    assert wide / tall == pytest.approx(30 / 20, rel=0.15)
