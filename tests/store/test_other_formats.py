"""Files of other programs are named as what they are, with what to do."""

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
            "Format Version,1.23,Take Name,beam,Capture Frame Rate,120.0,Length Units,Meters\n\n,,Marker,Marker\n",
            f"a CSV file of OptiTrack Motive, which cqrun does not read: export the take as C3D in Motive, or {LONG}",
        ),
        ("a.csv", "Trajectories\n100\n,,S:tip,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n", "is a CSV file of Vicon, which"),
        ("a.tsv", "NO_OF_FRAMES\t500\nNO_OF_CAMERAS\t8\nFREQUENCY\t100\n", "is a TSV file of Qualisys, which"),
        ("a.trc", "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\n", "is a TRC file (OpenSim, Cortex), which"),
        ("a.csv", "scorer,net,net,net\nbodyparts,tip,tip,tip\ncoords,x,y,likelihood\n", "is a CSV file of DeepLabCut"),
        ("a.csv", "time,tip_x,tip_y,tip_z\n0,1,2,3\n", f"each marker, which cqrun does not read: {LONG}"),
        ("a.csv", 'Frame,"Tip - 1:X","Tip - 1:Y"\n0,1,2\n', "has a column for each coordinate of each marker"),
        ("a.csv", "time;marker;x;y;z\n0,0;tip;1,5;2;3\n", "has columns that are separated by semicolons: write commas"),
        ("a.txt", "time\tmarker\tx\ty\n0\ttip\t1\t2\n", "has columns that are separated by tabs: write commas"),
        ("a.csv", "\ufefftime,marker,x,y\n0,a,1,2\n".encode("utf-16-le"), "is text in UTF-16: save it as UTF-8"),
        ("a.xlsx", b"PK\x03\x04" + bytes(40), "is a spreadsheet or another packed file: save its table as CSV text"),
        ("a.csv", b"\x89HDF\r\n\x1a\n" + bytes(40), "is an HDF5 file: if it is a trajectory.h5 of cqrun, let its"),
        ("a.csv", b"\x02\x50" + bytes(600), "is a C3D file: let its name end in .c3d"),
        ("a.csv", b"time,marker,x,y\n0,b\xf6se,1,2\n", "UTF-8: byte 0xf6 in 'rker,x,y\\n0,böse,1,2\\n'; save"),
        ("a.csv", "step,name,value\n", "the first line must be 'time,marker,x,y,z'"),
        ("a.mat", "MATLAB 5.0 MAT-file\n", "the name of a recording ends in .c3d, .csv, .h5, not in '.mat'"),
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
