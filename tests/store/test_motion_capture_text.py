"""Text of Motive, Nexus, Qualisys and TRC: what each program writes beside the markers, and headers that are wrong."""

from __future__ import annotations

import numpy as np
import pytest
from made_tables import motive, positions, qualisys, trc, vicon

from cqrun.errors import DataError
from cqrun.store.recordings import read_recording

X = 1e-3 * positions()


@pytest.fixture
def read(tmp_path):
    """Read a file of the given text."""

    def read_text(text, **options):
        path = tmp_path / "r.txt"
        path.write_text(text)
        return read_recording(path, **options)

    return read_text


def refused(read, text, words):
    with pytest.raises(DataError) as caught:
        read(text)
    assert words in str(caught.value)


# ---------------------------------------------------------------- Motive


@pytest.mark.parametrize("words", [True, False])
def test_motive_markers_and_rigid_bodies_but_not_what_motive_expects(read, words):
    recording = read(motive(positions(), words=words))
    assert recording.names == ("arm:tip", "base", "clamp")
    np.testing.assert_allclose(recording.positions[:, :2], X)
    np.testing.assert_allclose(recording.positions[:, 2], [[0.007, 0.008, 0.009 + 0.001 * k] for k in range(4)])


def test_motive_a_marker_comes_before_a_rigid_body_of_its_name(read):
    recording = read(motive(positions(), ["clamp", "base"]))
    assert recording.names == ("clamp", "base")
    np.testing.assert_allclose(recording.positions, X)


def test_motive_other_columns_and_unlabeled_markers(read):
    head = "Format Version,1.24,Length Units,Centimeters\n\n"
    names = (
        ",Type,,Marker,Marker,Marker\n,Name,,Unlabeled 1189,Unlabeled 1189,Unlabeled 1189\n,ID,,9F,9F,9F\n,Parent,,,,\n"
    )
    axes = ",,,Position,Position,Position\nFrame,Time (Seconds),TimeCode,X,Y,Z\n"
    recording = read(f"{head}{names}{axes}0,0.5,15:26:46:12,1,2,3\n1,0.6,15:26:46:13,,,\n")
    assert recording.names == ("Unlabeled 1189",)
    np.testing.assert_allclose(recording.positions[0, 0], [0.01, 0.02, 0.03])
    np.testing.assert_array_equal(recording.time, [0.5, 0.6])


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("Millimeters", "Furlongs", ":1: its length unit is 'Furlongs', which is not known; give it with `units: m"),
        ("Length Units,Millimeters,", "", ":1: its length unit is missing; give it with `units:"),
        ("Frame,Time", "Image,Time", "without the lines that name its columns: export it again with `Header"),
    ],
)
def test_motive_headers_that_are_refused(read, before, after, words):
    assert before in motive(positions())
    refused(read, motive(positions()).replace(before, after), words)


def test_motive_without_measured_markers(read):
    text = motive(positions()).replace("Rigid Body,", "Bone,").replace(",Marker", ",Bone Marker")
    refused(read, text, "has no columns of the type Marker, only Bone, Rigid Body Marker, Bone Marker: export the take")


# ---------------------------------------------------------------- Vicon


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_vicon_trajectories_between_other_sections(read, separator):
    recording = read(vicon(positions(), separator=separator))
    assert recording.names == ("arm:tip", "base")
    np.testing.assert_allclose(recording.positions, X)


def test_vicon_decimal_commas(read):
    np.testing.assert_allclose(read(vicon(positions(), separator=";").replace(".", ",")).positions, X)


def test_vicon_the_first_frame_is_at_0_and_frames_may_be_missing(read):
    lines = vicon(positions(), rate=200.0).split("\n")
    del lines[next(k for k, line in enumerate(lines) if line.startswith("302,"))]
    np.testing.assert_allclose(read("\n".join(lines)).time, [0, 0.01, 0.015])


def test_vicon_blank_lines_do_not_end_a_section(read):
    text = vicon(positions())
    np.testing.assert_allclose(read(text.replace("\n303,", "\n\n303,")).positions, X)
    np.testing.assert_allclose(read("\n\n" + text.partition("\n\n")[2]).positions, X)  # without the section before it


def test_vicon_a_marker_without_a_name(read):
    assert read(vicon(positions(), ["", "base"])).names == ("unlabelled 0", "base")


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("Trajectories", "Model Outputs", "a CSV file of Vicon without a section Trajectories: export the"),
        ("Trajectories\n100", "Trajectories\nfast", ":9: the frame rate is 'fast'; it must be a positive number"),
        ("Trajectories\n100", "Trajectories\n0", ":9: the frame rate is '0'"),
        ("Sub Frame,X", "Part,X", ":11: must be 'Frame,Sub Frame,X,Y,Z,...', is 'Frame,Part,X"),
        ("Sub Frame,X,Y,Z,X,Y,Z", "Sub Frame,a,b,c,d,e,f", ":11: has no columns X, Y, Z of a marker, only a, b, c"),
        (",,mm,mm,mm,", ",,mm,mm,cm,", ":12: the coordinates have the units cm, mm: use one unit"),
        (",,mm,mm,mm,mm,mm,mm", ",,in,in,in,in,in,in", ":12: its length unit is 'in', which is not known"),
        ("\n302,", "\n301.5,", ":14: the frame is 301.5, not a whole number"),
        ("\n302,", "\n300,", ":14: the frame does not increase: 301 is followed by 300"),
    ],
)  # fmt: skip
def test_vicon_that_is_refused(read, before, after, words):
    text = vicon(positions())
    assert before in text
    refused(read, text.replace(before, after), words)


# ---------------------------------------------------------------- Qualisys


@pytest.mark.parametrize("columns", [True, False])
@pytest.mark.parametrize("clock", [0, 1, 2])
@pytest.mark.parametrize("gap", ["", "0.000"])
@pytest.mark.parametrize("end", ["\n", "\t\n"])
def test_qualisys_columns_before_the_markers_and_gaps(read, columns, clock, gap, end):
    text = qualisys(positions(), rate=50.0, columns=columns, clock=clock, gap=gap).replace("\n", end)
    recording = read(text)
    np.testing.assert_allclose(recording.positions, X)
    np.testing.assert_allclose(recording.time, 0.02 * np.arange(4))


def test_qualisys_a_frame_without_any_marker_counts(read):
    x = positions()
    x[2] = np.nan
    recording = read(qualisys(x, columns=False, clock=0))
    np.testing.assert_array_equal(recording.seen(), ~np.isnan(x[..., 0]))
    assert len(recording.time) == 4


def test_qualisys_an_external_clock_needs_times(read):
    text = qualisys(positions()).replace("FREQUENCY\t100", "FREQUENCY\tEXT")
    np.testing.assert_allclose(read(text).time, 0.01 * np.arange(4))
    text = qualisys(positions(), clock=0).replace("FREQUENCY\t100", "FREQUENCY\tEXT")
    refused(read, text, ":4 (FREQUENCY): the frame rate is 'EXT'; it must be a positive number")


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("DATA_INCLUDED\t3D", "DATA_INCLUDED\t6D", "its data (DATA_INCLUDED) are 6D, not 3D: export the measurement"),
        ("DATA_INCLUDED\t3D\n", "", "its data (DATA_INCLUDED) are missing"),
        ("MARKER_NAMES\tarm:tip\tbase\n", "", "has no markers (MARKER_NAMES)"),
        ("MARKERS\t2", "MARKERS\t3", ":10: names 2 markers (MARKER_NAMES), and NO_OF_MARKERS is 3: the file"),
    ],
)  # fmt: skip
def test_qualisys_headers_that_are_refused(read, before, after, words):
    refused(read, qualisys(positions()).replace(before, after), words)


def test_qualisys_lines_that_do_not_fit_the_markers(read):
    text = (
        qualisys(positions(), columns=False, clock=0)
        .replace("base\n", "base\tfoot\n")
        .replace("MARKERS\t2", "MARKERS\t3")
    )
    refused(read, text, ":12: has 6 columns, and 3 markers have 9")
    blank = qualisys(positions()[1:][:, ::-1], columns=False, clock=1)  # does a tab end the line, or a gap?
    refused(read, blank, ":12: has 7 columns, and 2 markers have 6")
    refused(read, qualisys(positions()).replace("\n2\t", "\n2\t0.005\t"), ":14: 9 columns instead of 8")


def test_qualisys_a_wrong_first_line_is_not_taken_for_names(read):
    refused(
        read, qualisys(positions(), columns=False).replace("-2.0", "-2.O"), ":12:11: x of marker 'arm:tip' is '-2.O'"
    )


# ---------------------------------------------------------------- TRC


def test_trc_names_without_empty_cells_between_them(read):
    text = trc(positions()).replace("arm:tip\t\t\tbase\t\t", "arm:tip\tbase")
    assert read(text).names == ("arm:tip", "base")


def test_trc_without_a_blank_line_or_a_frame_rate(read):
    text = trc(positions()).replace("\n\n", "\n").replace("\n100\t", "\n\t", 1)
    np.testing.assert_allclose(read(text).positions, X)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("\tmm\t", "\tinch\t", ":3: its length unit is 'inch', which is not known"),
        ("Frame#\tTime", "Frame Time", ":4: must be 'Frame#', 'Time' and the names of the markers, with tabs"),
        ("\tbase", "\t", ":4: names 1 markers, and NumMarkers is '2'"),
        ("100\t100\t4\t2", "100\t100\t4\t99999999999", ":4: names 2 markers, and NumMarkers is '99999999999'"),
        ("\tZ2", "\tW2", ":5: must be X1, Y1, Z1, X2, ... for 2 markers; is"),
        ("\n3\t0.020", "\n3\t", ":9: the time is nan; every line needs one"),
        ("\n3\t0.020", "\n3\t0.005", ":9: the time does not increase: 0.01 is followed by 0.005"),
    ],
)  # fmt: skip
def test_trc_that_is_refused(read, before, after, words):
    text = trc(positions())
    assert before in text
    refused(read, text.replace(before, after), words)


def test_trc_that_ends_in_its_header(read):
    refused(read, "".join(trc(positions()).splitlines(keepends=True)[:4]), "the file ends in its header")
