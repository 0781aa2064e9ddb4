"""Wide tables: how columns may be called, what separates them, decimal commas, and headers that are refused."""

from __future__ import annotations

import numpy as np
import pytest
from made_tables import long, positions, wide

from cqrun.errors import DataError
from cqrun.store.recordings import read_recording


@pytest.fixture
def read(tmp_path):
    """Read a table of the given text."""

    def read_text(text, suffix=".csv", **options):
        path = tmp_path / f"r{suffix}"
        path.write_text(text)
        return read_recording(path, **options)

    return read_text


@pytest.mark.parametrize(
    "form",
    ["tip_{}", "tip.{}", "tip {}", "tip:{}", "tip-{}", "tip/{}", "tip[{}]", "tip({})", "tip - {}", '"tip:{}"'],
)  # fmt: skip
@pytest.mark.parametrize("axes", ["xyz", "XYZ", "xy"])
def test_how_a_coordinate_may_be_called(read, form, axes):
    head = ",".join(form.format(axis) for axis in axes)
    cells = ",".join("123"[: len(axes)])
    recording = read(f"time,{head}\n0,{cells}\n1,{cells}\n")
    assert recording.names == ("tip",)
    np.testing.assert_array_equal(recording.positions, [[[1, 2, 3][: len(axes)]]] * 2)


def test_an_axis_in_capitals_may_follow_the_name_without_a_sign(read):
    assert read("t,tipX,tipY,m1X,m1Y\n0,1,2,3,4\n1,1,2,3,4\n").names == ("tip", "m1")
    with pytest.raises(DataError, match="must name the columns"):
        read("t,max,may,maz\n0,1,2,3\n1,1,2,3\n")  # they are words


@pytest.mark.parametrize(
    "form", ["tip [mm] {}", "tip (mm) {}", "tip_{}_mm", "tip_{} [mm]", "tip {}(mm)", "tip.{} [Millimeters]"]
)
def test_a_unit_in_the_name_of_a_column(read, form):
    head = ",".join(form.format(axis) for axis in "xy")
    recording = read(f"time,{head}\n0,1,2\n1,1,2\n")
    np.testing.assert_allclose(recording.positions[0, 0], [1e-3, 2e-3])
    assert recording.names == ("tip",)


@pytest.mark.parametrize(
    ("clock", "second"),
    [("time", 1), ("t", 1), ("Time", 1), ("time [s]", 1), ("time(s)", 1), ("Time (Seconds)", 1), ("time_s", 1),
     ("t/s", 1), ("Zeit", 1), ("Temps (ms)", 1e-3), ("time [ms]", 1e-3), ("time_ms", 1e-3), ("t (milliseconds)", 1e-3)],
)  # fmt: skip
def test_how_the_time_may_be_called(read, clock, second):
    recording = read(f"frame,{clock},tip_x,tip_y\n1,0,1,2\n2,20,1,2\n")
    np.testing.assert_allclose(recording.time, [0, 20 * second])


def test_without_a_unit_positions_are_in_metres(read):
    assert read("time,tip_x,tip_y\n0,1,2\n1,1,2\n").positions[0, 0, 0] == 1


def test_other_columns_comments_and_blank_lines_are_not_read(read):
    recording = read("# made by hand\n\ntime,force_N,tip_x,note,tip_y\n0,7,1,first,2\n# pause\n,,,,\n1,7,3,,4\n")
    assert recording.names == ("tip",)
    np.testing.assert_array_equal(recording.positions[:, 0], [[1, 2], [3, 4]])


def test_gaps(read):
    recording = read("time,a_x,a_y,b_x,b_y\n0,,,1,2\n1,nan,NaN, ,\n2,5,6,7,8\n")
    np.testing.assert_array_equal(recording.seen(), [[False, True], [False, False], [True, True]])


def test_a_marker_that_is_not_named_need_not_be_complete(read):
    table = "time,tip_x,tip_y,tip_z,cop_x,cop_y\n0,1,2,3,4,5\n1,1,2,3,4,5\n"
    assert read(table, names=["tip"]).dim == 3
    assert read(table, names=["cop"]).dim == 2
    with pytest.raises(DataError, match="marker 'cop' has columns for x, y and not for z"):
        read(table)


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("frame,tip_x,tip_y", ":1: the table has numbers of frames and no times: add a column 'time' in seconds"),
        ("Frame#,tip_x,tip_y", "numbers of frames and no times"),
        ("clock,tip_x,tip_y", "no column is called 'time', in 'clock,tip_x,tip_y'"),
        ("time (min),tip_x,tip_y", "no column is called 'time'"),
        ("clock;tip_x;tip_y", "no column is called 'time', in 'clock;tip_x;tip_y'"),  # as the file has it
        ("time,t,tip_x,tip_y", "the columns 'time', 't' are both times: keep one"),
        ("time,tip_x,tip_X", "the columns 'tip_x', 'tip_X' are the same: keep one"),
        ("time,tip_x,tip_z", "marker 'tip' has columns for x, z and not for y: a marker has x and y, or x, y and z"),
        ("time,x,y,z", "the columns 'x', 'y', 'z' do not say which marker they are of: write tip_x, tip_y"),
        ("time,tip_x_mm,tip_y_cm", "the columns 'tip_x_mm', 'tip_y_cm' have different units"),
        ("time,tip_x_mm,tip_y", "the columns 'tip_x_mm', 'tip_y' have different units"),
        ("time,marker,x,y,z,quality", "the first line must name the columns: time,marker,x,y,z"),
        ("0,1,2", "the first line must name the columns"),
    ],
)  # fmt: skip
def test_headers_that_are_refused(read, head, words):
    with pytest.raises(DataError) as caught:
        read(f"{head}\n0,1,2\n1,1,2\n")
    assert ":1: " in str(caught.value)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("0,1,2\n1,1\n", ":3: 2 columns instead of 3; is the file truncated?"),
        ("0,1,2\n0,1,1,0,2,0\n", ":3: 6 columns instead of 3; if commas in numbers are decimal, separate the"),
        ("0,1,2\n0,1,2\n", ":3: the time does not increase: 0 is followed by 0"),
        ("0,1,2\n,1,2\n", ":3: the time is nan; every line needs one"),
        ("0,1,2\n1,1,NA\n", ":3:5: y of marker 'tip' is 'NA', which is not a number"),
        ('0,1,2\n1,1,"2,5"\n', "y of marker 'tip' is '2,5', which is not a number: write decimal points"),
        ("", "has a header but no data"),
        ("0,1,2\n", "1 frames; a recording needs 2 or more"),
    ],
)  # fmt: skip
def test_lines_that_are_refused(read, lines, words):
    with pytest.raises(DataError) as caught:
        read(f"time,tip_x,tip_y\n{lines}")
    assert words in str(caught.value)


def test_an_empty_table(read):
    with pytest.raises(DataError, match="has no header and no data"):
        read("\n# nothing\n\n")


# ---------------------------------------------------------------- separators and decimals


@pytest.mark.parametrize("make", [wide, long])
@pytest.mark.parametrize(("separator", "suffix"), [(";", ".csv"), ("\t", ".tsv"), ("\t", ".txt")])
@pytest.mark.parametrize("comma", [False, True])
def test_separators_and_decimal_commas(read, make, separator, suffix, comma):
    text = make(positions(), separator=separator)
    recording = read(text.replace(".", ",") if comma else text, suffix, units="mm")
    np.testing.assert_allclose(recording.select(["arm:tip", "base"]).positions, 1e-3 * positions())
    np.testing.assert_allclose(recording.time, 0.01 * np.arange(4))


def test_a_name_may_contain_what_separates_columns(read):
    recording = read('time;"a;b_x";"a;b_y"\n0;1,5;2\n1;1,5;2\n')
    assert recording.names == ("a;b",)
    np.testing.assert_array_equal(recording.positions[0, 0], [1.5, 2])


@pytest.mark.parametrize("make", ["time;tip_x;tip_y\n0;{};2\n1;{};3\n", "time;marker;x;y\n0;tip;{};2\n1;tip;{};3\n"])
@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ("1,234", "2,345", "'1,234', which may have a decimal comma or a comma between thousands, and no other number"),
        ("1,234", "2.345", "'2.345', with a decimal point, but the decimals of 1,234 in line 2 follow a comma"),
        ("1.5", "2,5", "'2,5', with a decimal comma, but the decimals of 1.5 in line 2 follow a point"),
        ("1.234,5", "2,5", "'1.234,5', with a comma and a point: write no signs between thousands"),
        ("0,5", "1,234,567", "'1,234,567', which is not a number"),
        ("1.5", "1.234.567", "'1.234.567', which is not a number"),
    ],
)  # fmt: skip
def test_decimals_that_could_mean_something_else(read, make, first, second, words):
    text = make.format(first, second)
    with pytest.raises(DataError) as caught:
        read(text)
    assert words.replace(", which may", " may") in str(caught.value) or words in str(caught.value)
    line = 2 if first in words.split("'")[1] else 3
    column = text.split("\n")[line - 1].index(first if line == 2 else second) + 1
    assert f":{line}:{column}: " in str(caught.value)


@pytest.mark.parametrize(
    ("number", "value"), [("0,123", 0.123), ("12,34", 12.34), ("1234,567", 1234.567), ("-0,5e1", -5)]
)
def test_one_number_that_can_only_be_decimal_decides(read, number, value):
    recording = read(f"time;tip_x;tip_y\n0;1,234;2\n1;1,234;{number}\n2;2,345;3\n")
    np.testing.assert_allclose(recording.positions[:, 0], [[1.234, 2], [1.234, value], [2.345, 3]])


def test_whole_numbers_need_no_decimals(read):
    np.testing.assert_array_equal(read("time\ttip_x\ttip_y\n0\t1\t2\n1\t3\t4\n", ".tsv").positions[1, 0], [3, 4])
