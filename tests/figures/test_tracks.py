"""tracks_<recording>.png: its coordinates, markers and numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_runs import swing

from cqrun.figures.run_data import Tracks
from cqrun.figures.style import styled
from cqrun.figures.tracks import (
    displacements,
    draw_recording,
    main_axes,
    main_coordinate,
    moving_axes,
    rms_over_markers,
    spread,
)


def make_tracks(rng, markers=3, dim=3, noise=1e-4) -> Tracks:
    time, data, model = swing(rng, markers, dim, noise)
    return Tracks("bare", tuple(f"m{i}" for i in range(markers)), time, data, model)


def test_only_coordinates_that_move_are_drawn(rng):
    tracks = make_tracks(rng)
    assert moving_axes(tracks) == [2]
    assert main_coordinate(tracks) == 2


def test_a_coordinate_that_moves_only_in_the_data_is_drawn(rng):
    tracks = make_tracks(rng, noise=0.0)
    tracks.data[:, 0, 1] += 1e-2 * np.sin(tracks.time)
    assert moving_axes(tracks) == [1, 2]


def test_a_marker_that_is_never_seen_has_no_effect(rng):
    tracks = make_tracks(rng)
    tracks.data[:, 1] = np.nan
    assert moving_axes(tracks) == [2]


def test_displacements_are_relative_to_the_first_frame_of_the_model(rng):
    data, model = displacements(make_tracks(rng))
    np.testing.assert_array_equal(model[0], 0.0)
    assert np.abs(data - model).max() < 1e-3


def test_the_plane_of_paths_has_the_largest_extent():
    model = np.zeros((2, 2, 3))
    model[:, 1] = [0.1, 0.0, 0.2]
    tracks = Tracks("r", ("a", "b"), np.array([0.0, 1.0]), model, model)
    assert main_axes(tracks) == (0, 2)


def test_spread_markers_are_far_apart():
    points = np.array([[0.0, 0.0], [0.1, 0.0], [1.0, 0.0], [0.5, 0.0]])
    assert spread(points, 3) == [0, 2, 3]
    assert spread(points[:2], 12) == [0, 1]


def test_frames_without_seen_markers_have_no_error():
    model = np.zeros((3, 2, 2))
    data = model.copy()
    data[0] = [[3e-3, 4e-3], [0.0, 0.0]]
    data[1] = np.nan
    time, error = rms_over_markers(Tracks("r", ("a", "b"), np.array([0.0, 0.1, 0.2]), data, model))
    np.testing.assert_array_equal(time, [0.0, 0.2])
    np.testing.assert_allclose(error, [np.sqrt(12.5e-6), 0.0])


def test_each_of_few_markers_has_a_line_and_dots(rng):
    tracks = make_tracks(rng)
    with styled():
        figure = draw_recording(tracks, "twin")
        figure.draw_without_rendering()
    displacement, error = figure.axes
    assert displacement.get_ylabel() == "z displacement (mm)"
    data, model = displacements(tracks)
    np.testing.assert_array_equal([line.get_ydata() for line in displacement.lines[::2]], 1e3 * data[:, :, 2].T)
    np.testing.assert_array_equal([line.get_ydata() for line in displacement.lines[1::2]], 1e3 * model[:, :, 2].T)
    np.testing.assert_array_equal([line.get_ydata() for line in error.lines[:3]], 1e3 * tracks.error.T)
    rmse = [f"m{i}  {1e3 * value:#.3g}" for i, value in enumerate(tracks.rmse_by_channel())]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == rmse
    assert figure.get_suptitle() == f"twin, bare (fitted): RMSE {1e3 * tracks.rmse():#.3g} mm"


@pytest.mark.parametrize("name", ["a$x_$", r"$\bad$", "$", r"50\%", "$a^", "_a"])
def test_names_are_drawn_literally(rng, tmp_path, name):
    with styled():
        figure = draw_recording(Tracks(name, (name,), *swing(rng, 1, 2)), name)
        figure.savefig(tmp_path / "names.png")
    assert figure.legends[0].get_texts()[0].get_text().startswith(name)
    assert name in figure.get_suptitle()


def test_the_title_says_that_a_recording_is_held_out(rng):
    tracks = make_tracks(rng)
    with styled():
        figure = draw_recording(replace(tracks, holdout=True), "twin")
    assert "(held out)" in figure.get_suptitle()


@pytest.mark.parametrize("dim", [2, 3])
def test_many_markers_are_paths_and_a_band(rng, dim):
    tracks = make_tracks(rng, markers=40, dim=dim)
    with styled():
        figure = draw_recording(tracks, "finger")
        figure.draw_without_rendering()
    paths, _, error = figure.axes
    assert paths.get_title(loc="left") == "Paths of 12 of 40 markers"
    assert len(paths.lines) == 24
    line = error.lines[0]
    np.testing.assert_allclose(line.get_ydata(), 1e3 * np.sqrt(np.mean(tracks.error**2, axis=1)))


def test_gaps_remain_gaps(rng):
    tracks = make_tracks(rng)
    tracks.data[5:9, 0] = np.nan
    with styled():
        figure = draw_recording(tracks, "twin")
        figure.draw_without_rendering()
    assert np.isnan(figure.axes[0].lines[0].get_ydata()[5:9]).all()
