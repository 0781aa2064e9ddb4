"""Files that cqrun does not read are named as what they are, with what to do."""

from __future__ import annotations

import os

import pytest

from cqrun.errors import DataError
from cqrun.store.recordings import read_recording

LONG = "write one line for each marker and frame: time,marker,x,y,z"


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        (
            "a.csv",
            "scorer,net,net,net\nbodyparts,tip,tip,tip\ncoords,x,y,likelihood\n",
            f"is a CSV file of DeepLabCut, which cqrun does not read: turn pixels into lengths, and {LONG}",
        ),
        ("a.csv", "\ufefftime,marker,x,y\n0,a,1,2\n".encode("utf-16-le"), "is text in UTF-16: save it as UTF-8"),
        ("a.xlsx", b"PK\x03\x04" + bytes(40), "is a spreadsheet or another packed file: save its table as CSV text"),
        ("a.csv", b"\x89HDF\r\n\x1a\n" + bytes(40), "is an HDF5 file: if it is a trajectory.h5 of cqrun, let its"),
        ("a.csv", b"\x02\x50" + bytes(600), "is a C3D file: let its name end in .c3d"),
        ("a.csv", b"time,marker,x,y\n0,b\xf6se,1,2\n", "UTF-8: byte 0xf6 in 'rker,x,y\\n0,böse,1,2\\n'; save"),
        ("a.trc", "time,tip_x,tip_y\n".encode("utf-16"), "is text in UTF-16: save it as UTF-8"),
        ("a.csv", b"Trajectories\n100\n,,b\xf6se,,\n", "not a text file in UTF-8: byte 0xf6"),
        (
            "a.mat",
            "MATLAB 5.0 MAT-file\n",
            "the name of a recording ends in .c3d, .csv, .tsv, .txt, .trc, .h5, not in '.mat'",
        ),
    ],
)  # fmt: skip
def test_it_is_named(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError) as caught:
        read_recording(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert words in str(caught.value)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize("name", ["a.csv", "a.c3d", "a.h5", "a.trc"])
def test_a_pipe_is_not_waited_for(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(DataError, match="not a regular file"):
        read_recording(tmp_path / name)
