"""The run data for pictures: exact numbers, and clear errors for missing or damaged files."""

from __future__ import annotations

import numpy as np
import pytest
from made_runs import (
    YOUNG,
    history,
    made_twin,
    plane_scene,
    swing,
    write_history,
    write_result,
    write_run,
    write_tracks,
)  # fmt: skip

from cqrun.errors import UsageError
from cqrun.figures.run_data import read_run, read_tracks


def test_tracks_are_read_as_they_were_written(tmp_path, rng):
    time = np.array([0.0, 0.01, 0.02])
    data, model = rng.normal(size=(2, 3, 2, 3))
    data[1, 0] = np.nan
    write_tracks(tmp_path, {"bare": (("Tip - 1", "b,c"), time, data, model)})
    (tracks,) = read_tracks(tmp_path / "tracks.csv", {"bare"})
    assert (tracks.recording, tracks.channels, tracks.holdout) == ("bare", ("Tip - 1", "b,c"), True)
    np.testing.assert_array_equal(tracks.time, time)
    np.testing.assert_array_equal(tracks.data, data)
    np.testing.assert_array_equal(tracks.model, model)


def test_errors_ignore_gaps(tmp_path):
    time, model = np.array([0.0, 0.01]), np.zeros((2, 2, 2))
    data = np.array([[[3e-3, 4e-3], [0.0, 1e-3]], [[np.nan, np.nan], [0.0, 1e-3]]])
    write_tracks(tmp_path, {"r": (("a", "b"), time, data, model)})
    (tracks,) = read_tracks(tmp_path / "tracks.csv")
    np.testing.assert_allclose(tracks.error, [[5e-3, 1e-3], [np.nan, 1e-3]])
    np.testing.assert_allclose(tracks.rmse_by_channel(), [5e-3, 1e-3])
    assert tracks.rmse() == pytest.approx(np.sqrt((25e-6 + 1e-6 + 1e-6) / 3))


def test_a_run_that_has_just_started_has_no_history(tmp_path):
    run = read_run(write_run(tmp_path, plane_scene({}), status="running"))
    assert (run.name, run.job, run.history, run.result, run.succeeded) == ("twin", "sysid", {}, None, False)


def test_an_incomplete_last_row_is_skipped(tmp_path):
    path = write_run(tmp_path, plane_scene({}), status="running")
    write_history(path, history(3, {}))
    with (path / "history.csv").open("a") as file:
        file.write("3,1.0")
    assert len(read_run(path).history["loss"]) == 3


def test_held_out_recordings_are_known_from_the_scene(tmp_path, rng):
    """A run that was extended and stopped has tracks, but no recordings in its result."""
    data = {name: {"file": f"{name}.csv", "holdout": name == "b", "markers": {"near": [0.03, 0.06]}} for name in "ab"}
    more = {"data": {"recordings": {name: {**entry, "body": "a"} for name, entry in data.items()}}}
    path = write_run(tmp_path, plane_scene({f"bodies.a.{YOUNG}": {"bounds": [1e5, 5e5]}}, **more), status="stopped")
    write_result(path, {}, None)
    write_tracks(path, {name: (("near",), *swing(rng, 1, 2)) for name in "ab"})
    assert [tracks.holdout for tracks in read_run(path).tracks()] == [False, True]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("run.json", None, "no run (it has no run.json)"),
        ("scene.yaml", None, "there is no scene.yaml; the run is incomplete"),
        ("history.csv", "iteration,loss,seconds\n0,one,1.0\n1,1.0,2.0\n", "history.csv:2: this row is damaged"),
        ("result.json", "{", "result.json: unreadable"),
        ("result.json", "[]", "result.json: is not a result"),
    ],
)
def test_the_error_names_a_missing_or_damaged_file(tmp_path, rng, name, content, message):
    path = made_twin(tmp_path, rng)
    (path / name).unlink()
    if content is not None:
        (path / name).write_text(content)
    with pytest.raises(UsageError) as error:
        read_run(path)
    assert message in str(error.value)
    assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "is not a table of markers"),
        ("recording,marker,time,data_x\n", "is not a table of markers"),
        ("recording,marker,time,data_x,model_x\nr,a,0.0,1.0,here\n", "damaged (could not convert"),
        ("recording,marker,time,data_x,model_x\nr,a,0,1,1\nr,b,0,1,1\nr,b,1,1,1\n", "damaged"),
    ],
)
def test_a_file_that_is_not_a_table_of_tracks_is_refused(tmp_path, content, message):
    (tmp_path / "tracks.csv").write_text(content)
    with pytest.raises(UsageError) as error:
        read_tracks(tmp_path / "tracks.csv")
    assert message in str(error.value)
