"""Alignment is exact for rigid motions, never mirrors, and refuses wrong data."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cqrun.errors import DataError
from cqrun.measurements.alignment import align, measure, still_mean
from cqrun.measurements.recording import Recording

REST = {
    3: {"a": (0.0, 0.0, 0.0), "b": (0.1, 0.0, 0.0), "c": (0.0, 0.05, 0.01), "d": (0.03, 0.0, 0.06)},
    2: {"a": (0.0, 0.0), "b": (0.1, 0.0), "c": (0.0, 0.05)},
}


def turned(dim, rng):
    """Return a rotation (D, D) and a translation (D,)."""
    if dim == 3:
        return Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    c, s = np.cos(2.5), np.sin(2.5)
    return np.array([[c, -s], [s, c]]), rng.normal(size=2)


def recorded(dim, rng, noise=0.0, frames=20):
    """Return a recording in rotated axes of markers that rest for 10 frames and then move, and the true motion."""
    rest = np.array(list(REST[dim].values()))
    motion = np.zeros((frames, *rest.shape))
    motion[10:] = rng.normal(scale=0.01, size=motion[10:].shape)
    rotation, translation = turned(dim, rng)
    seen = (rest + motion + noise * rng.normal(size=motion.shape)) @ rotation.T + translation
    return Recording(0.1 * np.arange(frames), tuple(REST[dim]), seen, "beam.csv"), motion


@pytest.mark.parametrize("dim", [2, 3])
def test_displacements_are_in_the_frame_of_the_scene(rng, dim):
    recording, motion = recorded(dim, rng)
    measured = measure(recording, REST[dim], (0.0, 0.9))
    np.testing.assert_allclose(measured.values, motion, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(measured.alignment.rotation), 1.0)
    assert measured.alignment.residuals.max() < 1e-14


@pytest.mark.parametrize("dim", [2, 3])
def test_a_mirror_image_is_not_accepted_as_a_rotation(rng, dim):
    recording, _ = recorded(dim, rng)
    mirrored = Recording(recording.time, recording.names, recording.positions * ([1.0, -1.0, 1.0][:dim]), "beam.csv")
    with pytest.raises(DataError, match=r"mm from its rest position, more than 5 mm .*'b' "):
        measure(mirrored, REST[dim], (0.0, 0.9))


def test_gaps_remain_gaps_and_do_not_change_the_mean(rng):
    recording, motion = recorded(3, rng)
    recording.positions[3, 1] = recording.positions[15, 2] = np.nan
    measured = measure(recording, REST[3], (0.0, 0.9))
    motion[3, 1] = motion[15, 2] = np.nan
    np.testing.assert_allclose(measured.values, motion, atol=1e-14)


def test_recordings_in_the_scenes_frame_are_not_changed(rng):
    recording, _ = recorded(3, rng)
    measured = measure(recording, REST[3], None)
    assert measured.absolute
    assert measured.alignment is None
    np.testing.assert_array_equal(measured.values, recording.positions)


def test_residual_is_reported_per_marker(rng):
    rest = np.array(list(REST[3].values()))
    mean = rest.copy()
    mean[1] += (0.002, 0.0, 0.0)  # along the line to the others, so that no rotation can compensate it
    residuals = align(mean, rest, tuple(REST[3])).residuals
    assert residuals.argmax() == 1
    assert 5e-4 < residuals.max() < 2e-3


@pytest.mark.parametrize("size", [0.018, 0.006])
def test_swapped_names_on_a_small_body(size):
    """Its markers are so close together that after the best rotation none is 5 mm away."""
    shape = np.array([[0.0, 0.0, 0.0], [0.11, 0.16, 0.11], [0.55, 0.0, 0.22], [1.0, 0.16, 0.0]])
    rest, names = size * shape, tuple("abcd")
    scratched = rest + 0.01 * size * np.eye(4, 3)
    assert align(scratched, rest, names).residuals.max() < 0.02 * size
    for order in ([1, 0, 2, 3], [0, 1, 3, 2], [3, 2, 1, 0], [1, 2, 3, 0]):
        with pytest.raises(DataError, match=r"more than 0\.\d+ mm, 5% of the markers' extent, .*two names are swapped"):
            align(rest[order], rest, names, "beam.csv")


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (1000, "units: mm"),
        (100, "units: cm"),
        (10, "in millimetres, not centimetres"),
        (0.1, "in centimetres, not millimetres"),
        (0.01, "in metres, not centimetres"),
        (0.001, "in metres, not milli"),
    ],
)
def test_wrong_units_are_recognised(rng, factor, words):
    recording, _ = recorded(3, rng)
    wrong = Recording(recording.time, recording.names, factor * recording.positions, "beam.csv")
    with pytest.raises(DataError, match=words):
        measure(wrong, REST[3], (0.0, 0.9))


@pytest.mark.parametrize("distance", [0.0, 1.5])
def test_marker_that_is_always_at_0_is_named(rng, distance):
    """It makes the others look wrong: at wrong places, or on one line if they are 1.5 m from it."""
    recording, _ = recorded(3, rng)
    positions = recording.positions + distance
    positions[:, 1] = 0.0
    with pytest.raises(DataError, match="; marker 'b' is at exactly 0: if it was not seen, leave it out"):
        measure(Recording(recording.time, recording.names, positions, "beam.csv"), REST[3], (0.0, 0.9))


def test_too_few_collinear_or_coincident_markers(rng):
    recording, _ = recorded(3, rng)
    with pytest.raises(DataError, match="2 alignment markers; a rigid alignment in 3D needs 3 or more"):
        measure(recording, {k: REST[3][k] for k in "ab"}, (0.0, 0.9))
    line = {"a": (0.0, 0.0, 0.0), "b": (0.1, 0.0, 0.0), "c": (0.05, 0.0, 0.0)}
    with pytest.raises(DataError, match="rest positions of the markers lie on one line"):
        measure(recording, line, (0.0, 0.9))
    flat = Recording(recording.time, recording.names, recording.positions * [1.0, 0.0, 0.0], "beam.csv")
    with pytest.raises(DataError, match="recorded markers lie on one line"):
        measure(flat, REST[3], (0.0, 0.9))
    with pytest.raises(DataError, match="all at one place"):
        measure(recording, dict.fromkeys("abc", (0.0, 0.0, 0.0)), (0.0, 0.9))


def test_unknown_markers_other_dimensions_and_unseen_markers_are_refused(rng):
    recording, _ = recorded(3, rng)
    with pytest.raises(DataError, match="no marker 'A'"):
        measure(recording, {"A": (0, 0, 0)}, (0.0, 0.9))
    with pytest.raises(DataError, match="the recording is 3D and the scene 2D"):
        measure(recording, {"a": (0, 0)}, (0.0, 0.9))
    recording.positions[:, 2] = np.nan
    with pytest.raises(DataError, match="marker 'c' is NaN in every frame"):
        measure(recording, REST[3], (0.0, 0.9))


@pytest.mark.parametrize("dim", [2, 3])
def test_still_frames_show_the_accuracy_of_their_mean(rng, dim):
    """Their displacements are relative to the mean; recordings in the scene's frame have no still frames."""
    recording, _ = recorded(dim, rng, noise=1e-4)
    recording.positions[3, 1] = np.nan
    measured = measure(recording, REST[dim], (0.0, 0.9))
    assert measured.still.shape == (10, len(REST[dim]), dim)
    assert np.isnan(measured.still[3, 1]).all()
    np.testing.assert_allclose(np.nanmean(measured.still, axis=0), 0, atol=1e-12)
    assert np.nanstd(measured.still) == pytest.approx(1e-4, rel=0.4)
    assert measure(recording, REST[dim], None).still.shape == (0, len(REST[dim]), dim)


def test_still_frames(rng):
    recording, _ = recorded(3, rng)
    for still in ((-0.5, 0.5), (0.5, 5.0), (0.5, 0.5)):
        with pytest.raises(DataError, match=r"do not lie inside the recording, 0 to 1.9 s"):
            still_mean(recording, still)
    recording.positions[:10, 0] = np.nan
    with pytest.raises(DataError, match=r"marker 'a' is not seen in any still frame, 0 to 0.9 s"):
        still_mean(recording, (0.0, 0.9))
