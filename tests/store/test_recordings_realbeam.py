"""The recordings of the real silicone beam agree with the numbers published with them."""

from __future__ import annotations

import os
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from cqrun.measurements.alignment import Measured, measure
from cqrun.measurements.plausible import plausible
from cqrun.store.recordings import read_recording

FOLDER = Path(os.environ.get("CQRUN_SHARED_DATA", Path(__file__).parents[3] / "shared" / "data")) / "realbeam"

pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(),
    reason="the recordings of the real beam are not here: put them into ../shared/data/realbeam, "
    "or name the folder that holds realbeam/ in CQRUN_SHARED_DATA",
)

REST = {
    "Tip - 1": (0, 0.015, 0.036),
    "Tip - 2": (0, -0.006, 0.024),
    "Tip - 3": (0, 0.036, 0.006),
    "Base - 1": (-0.094, -0.010, -0.001),
    "Base - 2": (-0.094, 0.040, 0.0275),
    "Base - 3": (-0.094, 0.040, 0),
}


def measured(name: str, still: tuple[float, float]) -> Measured:
    return measure(read_recording(FOLDER / name), REST, still)


@pytest.mark.parametrize(
    ("name", "frames", "still", "residuals", "settled"),
    [
        ("beam_gravity_V2_a.c3d", 500, (0.2, 0.69), (0.36, 1.15), (-6.50, -6.52, -6.38)),
        ("beam_load101_V2_a.c3d", 600, (0.2, 0.50), (0.53, 1.84), (-27.08, -26.14, -25.00)),
    ],
)
def test_published_residuals_and_final_displacements(name, frames, still, residuals, settled):
    beam = measured(name, still)
    assert beam.values.shape == (frames, 6, 3)
    assert not np.isnan(beam.values).any()
    np.testing.assert_allclose(np.diff(beam.time), 0.01)
    aligned = 1e3 * beam.alignment.residuals
    np.testing.assert_allclose((aligned.min(), aligned.max()), residuals, atol=0.03)
    np.testing.assert_allclose(1e3 * beam.values[-20:, :3, 2].mean(axis=0), settled, atol=0.07)


@pytest.mark.parametrize("name", ["beam_gravity_V2_a.c3d", "beam_load101_V2_a.c3d"])
@pytest.mark.parametrize("reach", [0.01, 0.11])
def test_nothing_in_them_is_doubted(name, reach):
    recording = read_recording(FOLDER / name)
    found, doubts = plausible(recording, reach, (0.0, 10.0))
    assert doubts == ()
    np.testing.assert_array_equal(found.positions, recording.positions)


@pytest.mark.parametrize("name", ["beam_gravity_V2_a.c3d", "beam_load101_V2_a.c3d"])
def test_they_are_read_as_ezc3d_reads_them(name):
    theirs = np.array(ezc3d.c3d(str(FOLDER / name))["data"]["points"])[:3].transpose(2, 1, 0)
    np.testing.assert_array_equal(read_recording(FOLDER / name).positions, theirs)


def test_the_beam_is_still_before_its_release_and_swings_after():
    beam = measured("beam_gravity_V2_a.c3d", (0.2, 0.69))
    tip = 1e3 * beam.values[:, :3, 2].mean(axis=1)
    assert np.abs(tip[20:70]).max() < 0.1
    assert -11.0 < tip.min() < -9.5
    assert beam.time[tip.argmin()] == pytest.approx(0.77, abs=0.015)
