"""Recordings that are text, in every format: what is read, and what of damaged files is not read as something else."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from made_tables import FORMATS, NAMES, positions

from cqrun.errors import DataError
from cqrun.measurements.recording import Recording
from cqrun.store.formats import text as lines
from cqrun.store.recordings import marker_path, read_recording

OF_PROGRAMS = [name for name in FORMATS if name not in ("wide", "long")]


def written(folder: Path, name: str, content: str | bytes | None = None) -> Path:
    """Write a recording, as it should be or with another content."""
    suffix, make = FORMATS[name]
    path = folder / f"{name}{suffix}"
    content = make(positions()) if content is None else content
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", FORMATS)
def test_it_is_read_in_metres_and_seconds(tmp_path, name):
    recording = read_recording(written(tmp_path, name), units="mm" if name == "long" else None)
    picked = recording.select(NAMES)
    np.testing.assert_allclose(picked.positions, 1e-3 * positions(), rtol=1e-15)
    np.testing.assert_allclose(recording.time, 0.01 * np.arange(4), atol=1e-12)
    np.testing.assert_array_equal(picked.seen()[1], [False, True])


@pytest.mark.parametrize("name", FORMATS)
def test_only_the_named_markers_are_read_in_their_order(tmp_path, name):
    path = written(tmp_path, name)
    whole, both = read_recording(path), read_recording(path, names=["base", "arm:tip"])
    assert both.names == ("base", "arm:tip")
    np.testing.assert_array_equal(both.positions, whole.select(["base", "arm:tip"]).positions)
    for wanted, words in ((["tip"], "no marker 'tip' (did you mean 'arm:tip'?)"), ([], "it has")):
        with pytest.raises(DataError) as caught:
            read_recording(path, names=wanted)
        assert words in str(caught.value)
        assert "base" in str(caught.value)


@pytest.mark.parametrize("name", FORMATS)
def test_the_unit_of_the_scene_overrides_that_of_the_file(tmp_path, name):
    recording = read_recording(written(tmp_path, name), units="cm", names=NAMES)
    np.testing.assert_allclose(recording.positions, 1e-2 * positions())


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("ending", ["\r\n", "\r"])
def test_line_ends_of_other_systems_and_a_byte_order_mark(tmp_path, name, ending):
    expected = read_recording(written(tmp_path, name))
    content = FORMATS[name][1](positions()).replace("\n", ending)
    recording = read_recording(written(tmp_path, name, b"\xef\xbb\xbf" + content.encode()))
    np.testing.assert_array_equal(recording.positions, expected.positions)
    assert recording.names == expected.names


@pytest.mark.parametrize("name", OF_PROGRAMS)
@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".txt", ".trc"])
def test_the_beginning_tells_the_program_whatever_the_ending_is(tmp_path, name, suffix):
    path = written(tmp_path, name).rename(tmp_path / f"renamed{suffix}")
    np.testing.assert_allclose(read_recording(path, names=NAMES).positions, 1e-3 * positions())


@pytest.mark.parametrize("name", FORMATS)
def test_a_path_that_a_body_follows(tmp_path, name):
    time, x = marker_path(written(tmp_path, name), "mm", "arm:tip")
    np.testing.assert_allclose(time, [0, 0.02, 0.03])
    np.testing.assert_allclose(x, 1e-3 * positions()[[0, 2, 3], 0])


# ---------------------------------------------------------------- what is wrong with a line


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "long"])
def test_a_wrong_cell_is_named_with_its_line_and_column(tmp_path, name):
    content = FORMATS[name][1](positions())
    before = content[: content.index("3.75")]  # z of the second marker in the second line of data: 0.25 * 23 - 2
    line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
    with pytest.raises(DataError) as caught:
        read_recording(written(tmp_path, name, content.replace("3.75", "3.7S")))
    assert f":{line}:{column}: z of marker 'base' is '3.7S', which is not a number" in str(caught.value)


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "long"])
def test_a_marker_with_half_a_position(tmp_path, name):
    content = FORMATS[name][1](positions())
    line = content[: content.index("3.75")].count("\n") + 1
    with pytest.raises(DataError, match=rf":{line}: some coordinates of marker 'base' are missing and some are not"):
        read_recording(written(tmp_path, name, content.replace("3.75", "")))


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize(("number", "words"), [("inf", "it is at infinity"), ("1e30", "which no camera sees")])
def test_positions_that_no_camera_measures(tmp_path, name, number, words):
    content = FORMATS[name][1](positions()).replace("3.75", number)
    with pytest.raises(DataError, match=words):
        read_recording(written(tmp_path, name, content))


@pytest.mark.parametrize("name", OF_PROGRAMS)
def test_a_header_alone(tmp_path, name):
    with pytest.raises(DataError, match="has a header but no data"):
        read_recording(written(tmp_path, name, FORMATS[name][1](positions()[:0])))


@pytest.mark.parametrize("name", ["motive", "qualisys", "trc"])
def test_fewer_frames_than_the_header_promises(tmp_path, name):
    content = FORMATS[name][1](positions())
    with pytest.raises(DataError, match="truncated: its header promises 4 frames and 3 are there"):
        read_recording(written(tmp_path, name, content[: content.rindex("\n", 0, -1) + 1]))


@pytest.mark.parametrize("name", ["motive", "qualisys", "trc"])
def test_a_promise_of_many_frames_takes_no_memory(tmp_path, name):
    content = FORMATS[name][1](positions())
    promised = {"motive": "Frames,4,", "qualisys": "FRAMES\t4\n", "trc": "100\t100\t4\t"}[name]
    tracemalloc.start()
    with pytest.raises(DataError, match="promises 99999999999 frames and 4 are there"):
        read_recording(written(tmp_path, name, content.replace(promised, promised.replace("4", "99999999999"))))
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


@pytest.mark.parametrize("name", ["motive", "qualisys", "trc"])
def test_times_that_contradict_the_frame_rate(tmp_path, name):
    content = FORMATS[name][1](positions())
    rate = {"motive": "Export Frame Rate,100", "qualisys": "FREQUENCY\t100", "trc": "\n100\t"}[name]
    with pytest.raises(DataError, match=r"its header says 120 frames per second, and its times are 0.01 s apart"):
        read_recording(written(tmp_path, name, content.replace(rate, rate.replace("100", "120"))))


@pytest.mark.parametrize("name", ["motive", "trc"])
def test_times_that_are_rounded_or_left_out_do_not_contradict_the_frame_rate(tmp_path, name):
    content = FORMATS[name][1](positions(40), rate=300.0).split("\n")  # 0.003 s and 0.004 s apart if rounded
    del content[-25:-20]
    joined = "\n".join(content).replace("Frames,40", "Frames,35").replace("300\t40\t", "300\t35\t")
    assert len(read_recording(written(tmp_path, name, joined)).time) == 35


# ---------------------------------------------------------------- damage


def read_or_refused(path: Path) -> Recording | None:
    """Return a recording as it should be, or None if it is refused with one line."""
    try:
        recording = read_recording(path)
    except DataError as error:
        message = str(error)
        assert (message[: len(str(path)) + 1], message.count("\n")) == (f"{path}:", 0)
        return None
    assert recording.positions.shape == (len(recording.time), len(recording.names), recording.dim)
    assert (np.diff(recording.time) > 0).all()
    return recording


@pytest.mark.parametrize("name", FORMATS)
def test_a_file_that_is_cut_anywhere(tmp_path, name):
    """It is refused, or has the frames before the cut: the last number alone may have lost its last digits."""
    content = FORMATS[name][1](positions()).encode()
    whole = read_recording(written(tmp_path, name))
    for size in range(len(content)):
        cut = read_or_refused(written(tmp_path, name, content[:size]))
        if cut is not None and cut.names == whole.names:
            np.testing.assert_array_equal(cut.positions[:-1], whole.positions[: len(cut.time) - 1])


@pytest.mark.parametrize("name", FORMATS)
def test_bytes_that_change(tmp_path, name, rng):
    content = FORMATS[name][1](positions()).encode()
    for _ in range(600):
        changed = bytearray(content)
        for at in rng.integers(len(content), size=rng.integers(1, 4)):
            changed[at] = rng.choice([changed[at] ^ (1 << rng.integers(8)), rng.integers(256), *b'\t\n\r",;-.\0'])
        read_or_refused(written(tmp_path, name, bytes(changed)))


@pytest.mark.parametrize("name", FORMATS)
def test_cells_that_change(tmp_path, name, rng):
    content = FORMATS[name][1](positions())
    tokens = ["", "nan", "inf", "-0", "1e400", "9" * 400, "1_0", "1,5", '"', "x" * 200_000, "#", "time", "X", "Frame",
              "Trajectories", "MARKER_NAMES", "\x1b[2J", " " * 100_000, "[" * 50_000, "\n\n", "\u0661"]  # fmt: skip
    separator = "\t" if name in ("qualisys", "trc") else ","
    for k in range(200):
        cells = content.split(separator)
        cells[rng.integers(len(cells))] = tokens[k % len(tokens)]
        read_or_refused(written(tmp_path, name, separator.join(cells)))


@pytest.mark.parametrize("name", FORMATS)
def test_a_line_that_never_ends(tmp_path, name, monkeypatch):
    monkeypatch.setattr(lines, "LONGEST", 10_000)
    content = FORMATS[name][1](positions()).partition("\n\nJoints")[0]
    path = written(tmp_path, name, content + "\n" + "1," * 20_000)
    with pytest.raises(DataError, match="a line of 10,000 characters or more"):
        read_recording(path)


def test_a_large_table_takes_the_memory_of_the_named_markers_alone(tmp_path):
    """All numbers would take 9.6 MB, and the text 3 MB."""
    path = tmp_path / "a.csv"
    head = ",".join(f"m{m}_{axis}" for m in range(200) for axis in "xyz")
    path.write_text(f"time,{head}\n" + "".join(f"{0.01 * k!r}" + ",1.5" * 600 + "\n" for k in range(2000)))
    tracemalloc.start()
    recording = read_recording(path, names=["m150", "m7"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert recording.positions.shape == (2000, 2, 3)
    assert peak < 2e6
