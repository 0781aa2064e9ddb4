"""Read every format, and refuse every kind of wrong recording with a clear message."""

from __future__ import annotations

import re
import struct
import tracemalloc
from pathlib import Path

import h5py
import made_c3d
import numpy as np
import pytest

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording, check_recording, unit_of
from cqrun.store import hdf5
from cqrun.store.formats.long_table import write_csv
from cqrun.store.recordings import read_recording

NAMES = ("Tip - 1", "Tip - 2", "Base")


def write_c3d(path, positions, *, names=NAMES, **options):
    """Write (T, M, 3) positions of the markers as a C3D file."""
    return made_c3d.write_c3d(path, positions, names=names, **options)


@pytest.fixture
def positions(rng):
    return rng.normal(size=(12, 3, 3)).astype(np.float32).astype(float)


@pytest.fixture
def text(tmp_path):
    """Write a CSV file from its data lines."""

    def write(*lines, header="time,marker,x,y,z"):
        path = tmp_path / "r.csv"
        path.write_text("\n".join((header, *lines)) + "\n")
        return path

    return write


def refused(path, *words, **options):
    """Assert that `path` is refused with a message that names the file, the key path and `words`."""
    with pytest.raises(DataError) as caught:
        read_recording(path, where="data.recordings.bare", **options)
    message = str(caught.value)
    for word in ("data.recordings.bare", Path(path).name, *words):
        assert word in message


# ---------------------------------------------------------------- C3D


def test_c3d_is_read_in_metres_and_seconds(tmp_path, positions):
    recording = read_recording(write_c3d(tmp_path / "a.c3d", positions, rate=120.0))
    np.testing.assert_array_equal(recording.positions, positions)
    np.testing.assert_allclose(recording.time, np.arange(12) / 120)
    assert recording.names == NAMES


@pytest.mark.parametrize(("units", "scale"), [("mm", 1e-3), ("cm", 1e-2), ("Millimeters", 1e-3), ("m", 1.0)])
def test_c3d_units_of_the_file(tmp_path, positions, units, scale):
    path = write_c3d(tmp_path / "a.c3d", positions, units=units)
    np.testing.assert_allclose(read_recording(path).positions, scale * positions)
    np.testing.assert_allclose(read_recording(path, units="cm").positions, 0.01 * positions)


def test_c3d_markers_that_were_not_seen_are_nan(tmp_path, positions):
    positions[4, 1] = np.nan
    residuals = np.zeros((12, 3))
    residuals[7, 2] = -1
    recording = read_recording(write_c3d(tmp_path / "a.c3d", positions, residuals=residuals))
    lost = np.zeros((12, 3), dtype=bool)
    lost[4, 1] = lost[7, 2] = True
    np.testing.assert_array_equal(recording.seen(), ~lost)
    assert np.isnan(recording.positions[lost]).all()


def test_c3d_without_units_asks_for_them(tmp_path, positions):
    path = write_c3d(tmp_path / "a.c3d", positions, units="furlong")
    refused(path, "'furlong'", "units: m | cm | mm")
    np.testing.assert_allclose(read_recording(path, units="m").positions, positions)


def test_c3d_without_frame_rate(tmp_path, positions):
    path = write_c3d(tmp_path / "a.c3d", positions, rate=123.0)
    path.write_bytes(path.read_bytes().replace(struct.pack("<f", 123.0), struct.pack("<f", 0.0)))
    refused(path, "frame rate")


@pytest.mark.parametrize("kept", [10, 600, -5, -100])
def test_c3d_truncated_anywhere(tmp_path, rng, kept):
    whole = write_c3d(tmp_path / "a.c3d", rng.normal(size=(200, 3, 3))).read_bytes()
    short = tmp_path / "short.c3d"
    short.write_bytes(whole.rstrip(b"\0")[:kept])
    refused(short, "truncated")


def test_not_c3d(tmp_path, rng):
    path = tmp_path / "a.c3d"
    path.write_bytes(b"time,marker,x,y,z\n" * 100)
    refused(path, "not a C3D file")
    path.write_bytes(b"\x02\x50" + rng.bytes(5000))
    refused(path, "not a C3D file")


@pytest.mark.parametrize("suffix", [".c3d", ".csv", ".tsv", ".txt", ".trc", ".h5"])
def test_missing_and_empty(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    refused(path, "no such file")
    path.touch()
    refused(path, "empty")


def test_unknown_format_and_units(tmp_path):
    path = tmp_path / "a.xlsx"
    path.touch()
    refused(path, ".c3d, .csv, .tsv, .txt, .trc, .h5", "'.xlsx'")
    refused(path.with_suffix(".csv"), "'inch'", "m, cm, mm", units="inch")


# ---------------------------------------------------------------- CSV


@pytest.mark.parametrize("dim", [2, 3])
def test_csv_round_trip_is_exact(tmp_path, rng, dim):
    positions = rng.normal(size=(9, 3, dim))
    positions[3, 1] = positions[8, 0] = np.nan
    written = Recording(np.cumsum(rng.random(9)), NAMES, positions, "here")
    write_csv(written, tmp_path / "a.csv")
    read = read_recording(tmp_path / "a.csv")
    np.testing.assert_array_equal(read.positions, positions)
    np.testing.assert_array_equal(read.time, written.time)
    assert read.names == NAMES


def test_csv_sorted_by_marker_units_and_comments(text):
    path = text("# camera 2", "0,a,1,2,3", "0.1,a,2,3,4", "", '0,"b, left",5,6,7', '0.1,"b, left",,,')
    recording = read_recording(path, units="mm")
    assert recording.names == ("a", "b, left")
    np.testing.assert_allclose(recording.positions[:, 0], [[1e-3, 2e-3, 3e-3], [2e-3, 3e-3, 4e-3]])
    np.testing.assert_array_equal(recording.seen(), [[True, True], [True, False]])


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["0,a,1,2,3", "0.1,a,1,2"], (":3:", "4 columns instead of 5", "truncated")),
        (["0,a,1,2,3", "0.1,a,1,two,3"], (":3:", "y is 'two'", "not a number")),
        (["0,a,1,2,3", "nan,a,1,2,3"], (":3:", "time is nan")),
        (["0,a,1,2,3", "0.1,a,1,nan,3"], (":3:", "marker 'a'", "some coordinates")),
        (["0,a,1,2,3", "0.1,a,1,inf,3"], ("marker 'a'", "infinity", "frame 1")),
        (["0,a,1,2,3", "0.2,a,1,2,3", "0.1,a,1,2,3"], (":4:", "time does not increase", "0.2 s", "0.1 s")),
        (["0,a,1,2,3", "0,a,1,2,3"], (":3:", "marker 'a' appears twice")),
        (["0,a,1,2,3", "0.2,a,1,2,3", "0,a,1,2,3"], (":4:", "marker 'a' appears twice")),
        (["0,a,1,2,3"], ("1 frames", "2 or more")),
        (["0,a,1,2,3", "0.1,a,1,-1e30,3"], ("marker 'a' in frame 1 (0.1 s)", "1e+30 m away, which no camera sees")),
        (["0,a,1,2,3", "0.1,a,1,1e308,3"], ("marker 'a' in frame 1", "1e+308 m away")),
        (["0,a,1,2,3", "1e300,a,1,2,3"], ("time of frame 1 is 1e+300 s", "times are in seconds")),
        (["-1e308,a,1,2,3", "1e308,a,1,2,3"], ("time of frame 0",)),
        ([], ("no data",)),
    ],
)
def test_csv_refused(text, lines, words):
    refused(text(*lines), *words)


def test_names_in_a_file_are_data_in_messages(text):
    path = text('0,"a\nerror: b\x1b[2J",1,2,3', '1,"a\nerror: b\x1b[2J",1,2,3')
    with pytest.raises(DataError) as info:
        read_recording(path).select(["tip"])
    assert str(info.value).endswith(r"no marker 'tip'; it has 'a\nerror: b\x1b[2J'")
    assert str(info.value).isprintable()


def test_csv_header_and_encoding(text, tmp_path):
    refused(text("0,a,1,2,3", header="t,name,x,y,z"), ":1:", "time,marker,x,y,z", "the columns 'x', 'y', 'z'")
    refused(text("0,a,1", header="step,name,value"), ":1:", "time,marker,x,y,z", "'step,name,value'", "recordings.md")
    (tmp_path / "b.csv").write_bytes(b"\x00\x81" * 50)
    refused(tmp_path / "b.csv", "not a text file in UTF-8")


def test_csv_reads_only_the_markers_that_are_named(text):
    """Every line has a time of its own: all markers and times together would take 2.4 GB."""
    path = text(*(f"{0.001 * k!r},m{k},1,2,3" for k in range(10_000)), "11,tip,4,5,6")
    tracemalloc.start()
    recording = read_recording(path, names=["tip", "m7"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6
    assert recording.names == ("tip", "m7")
    np.testing.assert_array_equal(np.argwhere(recording.seen()), [[7, 1], [10_000, 0]])
    refused(path, "10,001 lines for 10,001 markers at 10,001 times", "all markers of a frame have one time")
    refused(path, "no marker 'top' (did you mean 'tip'?)", names=["top"])
    refused(path, "`markers` is missing", "such as m0: [x, y, z]; it has m0, m1", names=[])


def test_a_marker_without_the_name_of_its_subject_is_recognised(text):
    path = text("0,arm:m1,1,2,3", "0,arm:m12,4,5,6")
    refused(path, "no marker 'm1' (did you mean 'arm:m1'?)", names=["m1"])


def test_time_of_a_marker_that_is_not_named_is_a_frame(text):
    recording = read_recording(text("0,a,1,2,3", "0.1,b,1,2,3", "0.2,a,1,2,3"), names=["a"])
    np.testing.assert_array_equal(recording.time, [0, 0.1, 0.2])
    np.testing.assert_array_equal(recording.seen()[:, 0], [True, False, True])


# ---------------------------------------------------------------- trajectories


def test_trajectory(tmp_path, rng):
    x = rng.normal(size=(4, 5, 2))
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["time"], file["particles/x"] = [0.0, 0.1, 0.2, 0.3], x
    recording = read_recording(tmp_path / "t.h5")
    np.testing.assert_array_equal(recording.select(["3", "0"]).positions, x[:, [3, 0]])


def test_trajectory_refused(tmp_path, rng):
    path = tmp_path / "t.h5"
    path.write_bytes(b"time,marker\n")
    refused(path, "not an HDF5 file")
    with h5py.File(path, "w") as file:
        file["time"] = [0.0, 0.1]
    refused(path, "no dataset /particles/x")
    with h5py.File(path, "a") as file:
        file["particles/x"] = rng.normal(size=(3, 5, 2))
    refused(path, "do not fit together")
    with h5py.File(path, "w") as file:
        file["time"], file["particles/x"] = [0.0, 0.1], np.full((2, 5, 2), np.nan)
    refused(path, "particle 0", "frame 0")
    with h5py.File(path, "w") as file:
        file["time"], file["particles/x"] = [0.1, 0.1], np.zeros((2, 5, 2))
    refused(path, "time does not increase", "frame 0", "frame 1")
    path.write_bytes(path.read_bytes()[:1500])
    refused(path, "truncated")


def test_trajectory_of_the_particles_that_are_named(tmp_path, rng):
    x = rng.normal(size=(40, 50, 3))
    for name, options in {"whole.h5": {}, "packed.h5": {"chunks": (7, 11, 3), "compression": "gzip"}}.items():
        with h5py.File(tmp_path / name, "w") as file:
            file["time"] = np.arange(40)
            file.create_dataset("particles/x", data=x, **options)
        np.testing.assert_array_equal(read_recording(tmp_path / name, names=["49", "7"]).positions, x[:, [49, 7]])
        for wrong in ("50", "-1", "007", "tip", "9" * 5000):
            refused(tmp_path / name, f"no marker '{wrong}': the markers of a trajectory are its", names=[wrong])
        refused(tmp_path / name, "`markers` is missing", "it has 0, 1, 2", names=[])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "'particles/x' claims 7.45 GiB, and the file holds 0 B of it"),
        ({"chunks": (1, 1000, 3), "compression": "gzip"}, "claims 7.45 GiB, and the file holds 0 B of it"),
        ({"dtype": "S8"}, "'particles/x' is no array of numbers"),
    ],
)
def test_trajectory_that_claims_more_than_it_has(tmp_path, options, words):
    """The size is refused before anything of it is allocated."""
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["time"] = np.arange(1000.0)
        file.create_dataset("particles/x", (1000, 333_333, 3), **{"dtype": "f8", **options})
    refused(tmp_path / "t.h5", words)


def test_trajectory_whose_numbers_are_elsewhere(tmp_path):
    """A recording names one file, and nothing else is read."""
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["time"], file["particles/x"] = [0.0, 0.1], np.zeros((2, 5, 2))
    source = h5py.VirtualSource(str(tmp_path / "other.h5"), "particles/x", shape=(2, 5, 2))
    virtual = h5py.VirtualLayout((2, 5, 2), float)
    virtual[:] = source
    for place, words in (
        (h5py.ExternalLink("other.h5", "/particles/x"), "'particles/x' is a link, perhaps to another file"),
        (h5py.SoftLink("/elsewhere"), "'particles/x' is a link, perhaps to another file"),
        (virtual, "the numbers of 'particles/x' are in another file"),
        (None, "the numbers of 'particles/x' are in another file"),
    ):
        with h5py.File(tmp_path / "t.h5", "w") as file:
            file["time"] = [0.0, 0.1]
            if place is virtual:
                file.create_virtual_dataset("particles/x", place)
            elif place is None:
                raw = [(str(tmp_path / "other.h5"), 0, 160)]
                file.create_dataset("particles/x", (2, 5, 2), "f8", external=raw)
            else:
                file["particles/x"] = place
        refused(tmp_path / "t.h5", words)


def test_trajectory_in_chunks_that_are_too_large(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "LARGEST_BLOCK", 1000)
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["time"] = np.arange(10.0)
        file.create_dataset("particles/x", data=np.zeros((10, 5, 3)), chunks=(10, 5, 3))
    refused(tmp_path / "t.h5", "its chunks are of 1.17 KiB, and at most 1000 B can be read at once (h5repack)")


# ---------------------------------------------------------------- markers


def test_select_unknown_and_repeated_markers(positions):
    recording = Recording(np.arange(12.0), ("Tip - 1", "Tip - 2", "Tip - 2"), positions, "beam.c3d")
    assert recording.select(["Tip - 1"]).positions.shape == (12, 1, 3)
    with pytest.raises(DataError, match=re.escape("beam.c3d: no marker 'Tip 1' (did you mean 'Tip - 1'?)")):
        recording.select(["Tip 1"])
    with pytest.raises(DataError, match="no marker 'Q'; it has 'Tip - 1', 'Tip - 2'"):
        recording.select(["Q"])
    with pytest.raises(DataError, match="'Tip - 2' appears 2 times"):
        recording.select(["Tip - 2"])


def test_time_that_is_not_a_number(positions):
    time = np.arange(12.0)
    time[5] = np.nan
    with pytest.raises(DataError, match="time of frame 5 is nan"):
        check_recording(Recording(time, NAMES, positions, "a"))


def test_units_by_name():
    assert [unit_of(u) for u in ("M", " mm", "metres", "Centimeters", "inch", "")] == [
        "m",
        "mm",
        "m",
        "cm",
        None,
        None,
    ]
