"""C3D files: the numbers of every processor, both forms of coordinates, and files that contradict themselves."""

from __future__ import annotations

import ezc3d
import numpy as np
import pytest
from made_c3d import DEC, INTEL, MIPS, Numbers, hand_made, write_c3d

from cqrun.errors import DataError
from cqrun.store.recordings import read_recording

NAMES = ("Tip - 1", "Tip - 2", "Base")


@pytest.fixture
def positions(rng):
    """Return positions (T, M, 3) [mm] that all forms represent exactly, one not seen."""
    positions = np.round(rng.normal(size=(12, 3, 3)) * 1000) * 0.25
    positions[5, 1] = np.nan
    return positions


@pytest.mark.parametrize("processor", [INTEL, DEC, MIPS])
@pytest.mark.parametrize("scale", [-0.25, 0.25])
@pytest.mark.parametrize("analog", [0, 4])
def test_every_processor_and_both_forms(tmp_path, positions, processor, scale, analog):
    path = hand_made(tmp_path / "a.c3d", positions, processor=processor, scale=scale, analog=analog, names=NAMES)
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.positions, 0.001 * positions)
    np.testing.assert_array_equal(recording.time, np.arange(12) / 100)
    assert recording.names == NAMES
    if processor == INTEL and not analog:  # it wants a group of them
        theirs = np.array(ezc3d.c3d(str(path))["data"]["points"])[:3].transpose(2, 1, 0)
        np.testing.assert_array_equal(theirs, positions)


def test_it_reads_what_ezc3d_reads(tmp_path, rng):
    residuals = np.zeros((40, 3))
    residuals[7, 2] = -1
    path = write_c3d(tmp_path / "a.c3d", rng.normal(size=(40, 3, 3)), rate=120.0, names=NAMES, residuals=residuals)
    theirs = np.array(ezc3d.c3d(str(path))["data"]["points"])[:3].transpose(2, 1, 0)
    np.testing.assert_array_equal(read_recording(path).positions, theirs)
    np.testing.assert_array_equal(read_recording(path, names=["Base"]).positions, theirs[:, 2:])


def test_more_markers_than_one_list_of_labels_holds(tmp_path, rng):
    names = [f"m{k}" for k in range(300)]
    path = write_c3d(tmp_path / "a.c3d", rng.normal(size=(2, 300, 3)), names=names)
    assert read_recording(path).names == tuple(names)


def test_markers_without_a_label_and_labels_that_are_not_utf8(tmp_path, positions):
    labels = (-1, (4, 2), b"b\xf6se" + b"tip\0")
    path = hand_made(tmp_path / "a.c3d", positions, names=NAMES, parameters={"POINT:LABELS": labels})
    assert read_recording(path).names == ("böse", "tip", "unlabelled 2")


def test_time_counts_from_the_first_frame_that_was_kept(tmp_path, positions):
    path = hand_made(tmp_path / "a.c3d", positions, first=301, names=NAMES)
    assert read_recording(path).time[0] == 0


@pytest.mark.parametrize("said", ["POINT:LONG_FRAMES", "TRIAL", "nothing"])
def test_more_frames_than_the_header_counts(tmp_path, said):
    positions = np.arange(66_000, dtype=float)[:, None, None] + np.zeros((1, 1, 3))
    numbers = Numbers(INTEL)
    parameters = {
        "POINT:LONG_FRAMES": {"POINT:LONG_FRAMES": (4, (), numbers.reals(66_000))},
        "TRIAL": {
            "TRIAL:ACTUAL_START_FIELD": (2, (2,), numbers.words(1, 0)),
            "TRIAL:ACTUAL_END_FIELD": (2, (2,), numbers.words(66_000 & 0xFFFF, 1)),
        },
        "nothing": {},
    }[said]
    path = hand_made(tmp_path / "a.c3d", positions, names=["a"], header={"last": 0xFFFF}, parameters=parameters)
    assert read_recording(path).positions[-1, 0, 0] == 65.999
    if said != "nothing":
        path.write_bytes(path.read_bytes()[:-16])
        with pytest.raises(DataError, match="truncated: its header promises 66000 frames and 65999 are there"):
            read_recording(path)


# ---------------------------------------------------------------- what a file claims


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": {"points": 7}}, r"another number of markers \(7\) than its parameter section \(3\)"),
        ({"header": {"points": 0xFFFF}}, "another number of markers"),
        ({"header": {"rate": 228.0}}, r"another frame rate \(228\) than its parameter section \(100\)"),
        ({"header": {"last": 0xFFFE}}, "promises 65534 frames and"),
        ({"header": {"data": 0}}, "parameter section is damaged"),
        ({"header": {"data": 0x7FFF}}, "promises 12 frames and 0 are there"),
        ({"parameters": {"POINT:USED": (3, (), b"\3\0")}}, "parameter section is damaged"),
        ({"parameters": {"POINT:USED": (2, (255,) * 200, b"\3\0")}}, "parameter section is damaged"),
        ({"parameters": {"POINT:LABELS": (-1, (255, 255, 255), b"")}}, "parameter section is damaged"),
        ({"parameters": {"POINT:LONG_FRAMES": (4, (), b"\0\0\xc0\x7f")}}, "parameter section is damaged"),  # NaN
        ({"parameters": {"POINT:LONG_FRAMES": (4, (), b"\0\0\x80\x7f")}}, "parameter section is damaged"),  # infinite
        ({"parameters": {"POINT:LONG_FRAMES": (4, (), b"\0\0\x80\x7e")}}, "truncated: its header promises 8507059"),
        (
            {"header": {"scale": 0.0}, "parameters": {"POINT:SCALE": (4, (), bytes(4))}},
            r"the scale of its coordinates \(POINT:SCALE\) is 0",
        ),
        ({"units": ""}, r"the units in the file \(POINT:UNITS\) are missing; give them with `units: m \| cm \| mm`"),
        ({"rate": -1.0}, r"its frame rate \(POINT:RATE\) is -1; it must be positive"),
        ({"analog": 0, "positions": np.zeros((12, 0, 3)), "names": ()}, "has no markers"),
    ],
)  # fmt: skip
def test_what_contradicts_itself_or_the_file_is_refused(tmp_path, positions, changes, message):
    given = {"positions": positions, "names": NAMES, **changes}
    path = hand_made(tmp_path / "a.c3d", **given)
    with pytest.raises(DataError, match=message):
        read_recording(path)


@pytest.mark.parametrize(("value", "words"), [(1e30, "1e+27 m away, which no camera sees"), (np.inf, "infinity")])
def test_positions_that_no_camera_measures(tmp_path, positions, value, words):
    positions[3, 2] = [0, value, 0]
    path = hand_made(tmp_path / "a.c3d", positions, names=NAMES)
    with pytest.raises(DataError) as caught:
        read_recording(path)
    assert "marker 'Base' in frame 3 (0.03 s)" in str(caught.value)
    assert words in str(caught.value)


def test_one_coordinate_that_is_not_a_number(tmp_path, positions):
    path = hand_made(tmp_path / "a.c3d", positions, names=NAMES)
    data = bytearray(path.read_bytes())
    place = len(data) - 16 * 3 * 12 + 16 * (3 * 4 + 2) + 4  # y of the last marker in frame 4
    data[place : place + 4] = b"\x01\x00\xa0\x7f"  # a signalling NaN
    path.write_bytes(bytes(data))
    with pytest.raises(DataError, match=r"marker 'Base' in frame 4 \(0.04 s\): some coordinates are nan and some are"):
        read_recording(path)
