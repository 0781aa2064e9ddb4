"""The history: its rows are durable, recording a row again is harmless, and outdated rows are dropped."""

from __future__ import annotations

import contextlib
import zlib

import numpy as np
import pytest

from cqrun.errors import UsageError
from cqrun.store.history import History, read_history

COLUMNS = ("loss", "value:a,b")


@pytest.fixture
def opened():
    """Return a function that opens a history, which is closed after the test."""
    with contextlib.ExitStack() as stack:
        yield lambda path, columns=COLUMNS: stack.enter_context(contextlib.closing(History(path, columns)))


@pytest.fixture
def history(tmp_path, opened):
    history = opened(tmp_path / "h.csv")
    for i in range(4):
        history.record(i, {"loss": 1 / (i + 3), "value:a,b": np.float64(i)}, seconds=10.0 + i)
    return history


def test_rows_are_on_disk_with_all_their_digits(tmp_path, history):
    lines = (tmp_path / "h.csv").read_text().splitlines()
    assert lines[0] == 'iteration,loss,"value:a,b",seconds,crc32'
    assert lines[2] == f"1,0.25,1.0,11.000,{zlib.crc32(b'1,0.25,1.0,11.000')}"
    assert float(lines[1].split(",")[1]) == 1 / 3
    assert (len(history), history.seconds) == (4, 13.0)
    assert read_history(tmp_path / "h.csv")["value:a,b"] == [0.0, 1.0, 2.0, 3.0]


def test_recording_a_row_again_keeps_its_seconds(tmp_path, history, opened):
    before = (tmp_path / "h.csv").read_bytes()
    history = opened(tmp_path / "h.csv")
    history.record(1, {"loss": 0.25, "value:a,b": 1.0}, seconds=99.0)
    assert (tmp_path / "h.csv").read_bytes() == before
    assert len(history) == 4


def test_a_different_row_drops_all_rows_after_it(tmp_path, history):
    history.record(1, {"loss": 0.125, "value:a,b": 1.0}, seconds=99.0)
    assert read_history(tmp_path / "h.csv")["loss"] == [1 / 3, 0.125]
    history.record(2, {"loss": 0.0, "value:a,b": 1.0}, seconds=100.0)
    assert read_history(tmp_path / "h.csv")["iteration"] == [0, 1, 2]


@pytest.mark.parametrize("incomplete", [b"4,0.1,1", b"4,0.1\n", b"4,0.1,0.2,", b"\x00\x00"])
def test_an_incomplete_last_row_is_dropped(tmp_path, history, opened, incomplete):
    path = history.path
    whole = path.read_bytes()
    path.write_bytes(whole + incomplete)
    assert read_history(path)["iteration"] == [0, 1, 2, 3]
    assert len(opened(path)) == 4
    assert path.read_bytes() == whole


def test_truncate_to_the_restored_iteration(history, opened):
    history.truncate(2)
    assert len(opened(history.path)) == 2


def test_a_gap_or_other_columns_are_refused(history, opened):
    with pytest.raises(ValueError, match="skipped"):
        history.record(5, {"loss": 0.0, "value:a,b": 0.0}, seconds=0.0)
    with pytest.raises(KeyError):
        history.record(4, {"loss": 0.0}, seconds=0.0)
    with pytest.raises(UsageError, match=r"columns are not those.*--fresh"):
        opened(history.path, ("loss",))
