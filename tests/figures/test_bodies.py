"""bodies.png: frames, views, depth, and boundaries."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from made_runs import DURATION, made_twin, plane_scene, write_run, write_trajectory

from cqrun.errors import UsageError
from cqrun.figures.bodies import draw_bodies, farthest_frame, plot_body, snapshots
from cqrun.figures.colours import colours
from cqrun.figures.overview import draw_overview
from cqrun.figures.run_data import TRAJECTORY, read_run
from cqrun.figures.scenery import boundary_section
from cqrun.figures.style import new_figure, styled
from cqrun.figures.views import of_equal_width, views, window
from cqrun.scene.load import load_scene
from cqrun.store.frames import Frames
from cqrun.units import Unit


def solid_scene(**world):
    """Return a 3D scene of one block."""
    material = {"density": 1000.0, "elastic": {"neo_hookean": {"youngs_modulus": 2e5, "poissons_ratio": 0.4}}}
    cube = {"box": {"corner": [0.02] * 3, "size": [0.04] * 3}}
    bodies = {"a": {"shape": cube, "particles_per_cell": 8, "material": material}}
    time = {"duration": DURATION, "control_step": 0.01, "substeps": 10}
    return load_scene(
        {
            "cqrun": 1,
            "world": {"size": [0.1] * 3, "dx": 0.01, "frame": "updated"} | world,
            "bodies": bodies,
            "time": time,
        }
    )


def falling(out: Path, depths: Sequence[int], points: np.ndarray) -> Frames:
    """Return frames, 0.1 s apart, of points (N, D) that have sunk by `depths` mm."""
    x = np.repeat(points[None], len(depths), axis=0)
    x[:, :, -1] -= 1e-3 * np.array(depths)[:, None]
    write_trajectory(out, x, 0.1 * np.arange(len(depths)))
    return Frames(out / TRAJECTORY)


@pytest.mark.parametrize(("frames", "times"), [(1, [0.0]), (2, [0.0, 0.1]), (5, [0.0, 0.2, 0.4])])
def test_first_middle_and_last_frame(tmp_path, rng, frames, times):
    with falling(tmp_path, range(frames), rng.random((4, 2))) as trajectory:
        shots = snapshots(trajectory)
    assert [shot.time for shot in shots] == pytest.approx(times)
    assert [shot.frame for shot in shots] == [round(10 * time) for time in times]


def test_no_frame_is_an_error(tmp_path, rng):
    with falling(tmp_path, (), rng.random((4, 2))) as trajectory, pytest.raises(UsageError, match="no frame in it yet"):
        snapshots(trajectory)


def test_the_farthest_frame_need_not_be_the_last(tmp_path, rng):
    with falling(tmp_path, (0, 1, 2, 3, 1), rng.random((4, 2))) as trajectory:
        assert farthest_frame(trajectory) == 3


def test_frames_are_read_one_at_a_time(tmp_path, rng, monkeypatch):
    """A trajectory may be larger than the memory."""
    run = read_run(made_twin(tmp_path, rng))
    monkeypatch.setattr(Frames, "read_all", None)
    with styled():
        draw_bodies(run)
        draw_overview(run)


def test_a_2d_world_has_one_view(rng):
    (view,) = views(load_scene(plane_scene({})), rng.random((5, 2)))
    assert view.names == "xy"
    np.testing.assert_array_equal(view.axes, np.eye(2))


def test_up_is_opposite_to_gravity_and_the_side_view_shows_the_long_side():
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    assert views(solid_scene(), corners)[0].names == "yz"
    assert views(solid_scene(gravity=[0, -9.81, 0]), corners)[0].names == "zy"


def test_views_are_orthonormal_and_the_oblique_one_looks_down():
    side, oblique = views(solid_scene(gravity=[0, 0, -9.81]), np.array([[0.0] * 3, [3.0, 1.0, 1.0]]))
    for view in (side, oblique):
        frame = np.vstack([view.axes, view.towards])
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(side.towards, [0, -1, 0])
    assert oblique.towards[2] > 0  # the eye is above


def test_near_particles_cover_far_ones(tmp_path):
    scene = solid_scene()
    x = np.array([[0.05, 0.02, 0.05], [0.02, 0.08, 0.02], [0.05, 0.08, 0.05]])
    with falling(tmp_path, [0], x) as trajectory:
        (shot,) = snapshots(trajectory)
    look = views(scene, np.array([[0.0] * 3, [0.1, 0.01, 0.01]]))[0]
    with styled():
        axes = new_figure(3, 3).add_subplot()
        dots = plot_body(axes, scene, shot, look, window(x, look, 0.01), Unit("mm", 1e3), np.eye(3))
    np.testing.assert_allclose(dots.get_offsets(), [[20, 20], [50, 50], [50, 50]])
    order = np.argsort(x @ look.towards, kind="stable")
    assert order[-1] == 0  # the eye is at smaller y, and that particle is nearest to it
    np.testing.assert_array_equal(dots.get_facecolor()[:, :3], np.eye(3)[order])


def test_boundaries_are_drawn_where_they_act():
    scene = load_scene(plane_scene({}))
    view = views(scene, np.zeros((1, 2)))[0]
    right, up, inside = boundary_section(scene, view, np.array([[-0.01, 0.0], [0.09, 0.1]]), np.zeros(2))
    assert inside.shape == (len(up), len(right))
    expected = (right >= 0.0) & (right <= 0.03)
    np.testing.assert_array_equal(inside[len(up) // 2], expected)


def test_windows_of_equal_width_keep_their_middles():
    wide, narrow = of_equal_width([np.array([[0.0, 0.0], [4.0, 1.0]]), np.array([[1.0, 0.0], [2.0, 5.0]])])
    np.testing.assert_array_equal(wide, [[0, 0], [4, 1]])
    np.testing.assert_array_equal(narrow, [[-0.5, 0], [3.5, 5]])


def test_the_picture_shows_positions_and_displacements(tmp_path, rng):
    run = read_run(made_twin(tmp_path, rng))
    with styled():
        figure = draw_bodies(run)
        figure.draw_without_rendering()
    x = run.trajectory().fields["x"]
    panels = figure.axes[:3]
    assert [axes.get_title(loc="left") for axes in panels] == ["t = 0 s", "t = 0.2 s", "t = 0.4 s"]
    for axes, frame in zip(panels, (0, 20, 40), strict=True):
        dots, count = axes.collections[-1], x.shape[1]
        np.testing.assert_allclose(dots.get_offsets()[-count:], 1e3 * x[frame])
        with run.frames() as frames:
            _, scheme = colours("displacement", run, frames)
            np.testing.assert_allclose(dots.get_facecolor()[-count:, :3], scheme.rgb(frame))
    assert (panels[0].get_xlabel(), panels[0].get_ylabel()) == ("x (mm)", "y (mm)")
    assert figure.axes[3].get_ylabel() == "displacement (mm)"


def test_a_body_that_does_not_move_is_drawn(tmp_path):
    path = write_run(tmp_path, plane_scene({}), job="simulate", status="done")
    write_trajectory(path, np.full((2, 1, 2), 0.05), np.array([0.0, 0.1]))
    with styled():
        draw_bodies(read_run(path)).draw_without_rendering()


def test_a_wanted_place_is_marked(tmp_path):
    objective = {"there": {"track": {"body": "b", "keys": [[0.4, 0.1, 0.05]]}}}
    path = write_run(tmp_path, plane_scene({}, data=None, objective=objective), status="converged")
    provenance = {"goals": {}, "courses": {"there": [[0.1, 0.05]]}}
    write_trajectory(path, np.array([[[0.02, 0.02], [0.12, 0.06]]]), np.array([0.0]), provenance=provenance)
    with styled():
        axes = draw_bodies(read_run(path)).axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xydata(), [[100, 50]])
    assert [text.get_text() for text in axes.texts] == ["there"]


def test_goals_and_courses_are_inside_the_window(tmp_path):
    """A goal that is drawn from a range is shown at its position in this run."""
    scene = plane_scene({}, goals={"far": {"position": [0.1, 0.05], "spread": [0.09, 0.04]}})
    path = write_run(tmp_path, scene, job="simulate", status="done")
    provenance = {"goals": {"far": [0.18, 0.02]}, "courses": {"wave": [[0.01, 0.09], [0.1, 0.05]]}}
    write_trajectory(path, np.array([[[0.05, 0.04], [0.1, 0.06]]]), np.array([0.0]), provenance=provenance)
    with styled():
        axes = draw_bodies(read_run(path)).axes[0]
    marks = {tuple(np.round(place, 9)) for line in axes.lines for place in line.get_xydata()}
    assert marks == {(180, 20), (10, 90), (100, 50)}
    for place in marks:
        assert axes.viewLim.contains(*place)


def test_a_clamp_that_moves_is_not_drawn_where_it_began():
    still = load_scene(plane_scene({}))
    view = views(still, np.zeros((1, 2)))[0]
    corners = np.array([[-0.01, 0.0], [0.09, 0.1]])
    (name, kind), *_ = ((name, chosen.name) for name, chosen in still.boundaries.items())
    moved = load_scene(plane_scene({}), [f"boundaries.{name}.{kind}.displacement=[0.01, 0]", "world.frame=reference"])
    assert boundary_section(still, view, corners, np.zeros(2))[2].any()
    assert not boundary_section(moved, view, corners, np.zeros(2))[2].any()
