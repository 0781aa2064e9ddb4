"""Trajectories: what h5py reads, what ParaView needs, and what remains after a kill."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from cqrun.errors import RunError, UsageError
from cqrun.store.frames import part_path
from cqrun.store.trajectory import TrajectoryWriter, read_trajectory

FRAMES, BODIES = 5, {"beam": slice(0, 6), "ball": slice(6, 9)}
PROVENANCE = {"scene": "cqrun: 1\n", "seed": 3, "versions": {"numpy": "2"}}


def frame(k, dim):
    base = np.arange(9 * dim, dtype=float).reshape(9, dim)
    return {
        "x": base + k / 3,
        "v": base - k,
        "activation": np.full(9, k / 7),
        "F": np.ones((9, dim, dim)) * k,
    }


def write(path, dim, count=FRAMES):
    fields = {"v": (dim,), "activation": (), "F": (dim, dim)}
    writer = TrajectoryWriter(path, FRAMES, BODIES, dim, fields, PROVENANCE)
    for k in range(count):
        writer.write(k, 0.1 * k, step=np.int64(17 * k), **frame(k, dim))
    return writer


@pytest.fixture(params=[2, 3])
def dim(request):
    return request.param


def test_a_trajectory_is_read_as_it_was_written(tmp_path, dim):
    with write(tmp_path / "t.h5", dim):
        assert not (tmp_path / "t.h5").exists()
    back = read_trajectory(tmp_path / "t.h5")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.h5", "t.vtkhdf"]
    assert (back.complete, back.bodies, back.provenance) == (True, BODIES, PROVENANCE)
    np.testing.assert_array_equal(back.time, 0.1 * np.arange(FRAMES))
    np.testing.assert_array_equal(back.step, 17 * np.arange(FRAMES))
    for k in range(FRAMES):
        for name, array in frame(k, dim).items():
            kind = np.float64 if name == "x" else np.float32
            assert back.fields[name].dtype == kind
            np.testing.assert_array_equal(back.fields[name][k], array.astype(kind))


def test_packed_for_reading(tmp_path, dim):
    with write(tmp_path / "t.h5", dim), h5py.File(part_path(tmp_path / "t.h5"), locking=False) as part:
        x = part["particles/x"]
        assert (x.chunks, x.shape) == (None, (FRAMES, 9, dim))  # contiguous and fully allocated
        assert x.id.get_storage_size() == x.size * 8
    with h5py.File(tmp_path / "t.h5") as file:
        v = file["particles/v"]
        assert (v.chunks, v.compression, v.compression_opts, v.shuffle) == ((1, 9, dim), "gzip", 1, True)
        np.testing.assert_array_equal(file["particles/body"], [0] * 6 + [1] * 3)
        assert file.attrs["scene"] == PROVENANCE["scene"]
        names = []
        file.visit(names.append)
        assert not [name for name in names if "seconds" in name or "thread" in name]


def test_datasets_name_their_units(tmp_path, dim):
    with write(tmp_path / "t.h5", dim):
        pass
    with h5py.File(tmp_path / "t.h5") as file:
        found = {name: dict(file[name].attrs) for name in ("time", "step", "particles/x", "particles/v", "particles/F")}
    assert found["time"] == {"unit": "s", "long_name": "time"}
    assert found["particles/x"] == {"unit": "m", "long_name": "position"}
    assert found["particles/v"] == {"unit": "m/s", "long_name": "velocity"}
    assert found["step"]["unit"] == "1"
    assert found["particles/F"] == {}  # a field that only this file has


def test_view_for_paraview(tmp_path, dim):
    """Check the structure of VTKHDF 2.0 temporal PolyData with one vertex per particle."""
    write(tmp_path / "t.h5", dim).close()
    with h5py.File(tmp_path / "t.h5") as file:
        vtk, points = file["VTKHDF"], file["VTKHDF/Points"]
        assert vtk.attrs["Type"] == b"PolyData"
        assert vtk.attrs.get_id("Type").get_type().get_size() == len("PolyData")
        np.testing.assert_array_equal(vtk.attrs["Version"], [2, 0])
        assert points.is_virtual
        assert points.virtual_sources()[0].file_name == "."  # so that the file can be renamed
        assert points.shape == (FRAMES * 9, 3)
        steps = vtk["Steps"]
        assert steps.attrs["NSteps"] == FRAMES
        np.testing.assert_array_equal(steps["Values"], file["time"])
        for k, start in enumerate(steps["PointOffsets"][()]):
            part = slice(start, start + vtk["NumberOfPoints"][0])
            expected = frame(k, dim)
            np.testing.assert_array_equal(points[part, :dim], expected["x"])
            assert dim == 3 or not points[part, 2].any()
            data = {n: d[part] for n, d in vtk["PointData"].items() if n != "body"}
            assert steps["PointDataOffsets/v"][k] == start
            np.testing.assert_array_equal(data["v"][:, :dim], expected["v"])
            np.testing.assert_array_equal(data["activation"], expected["activation"].astype("f4"))
            np.testing.assert_array_equal(data["F"], expected["F"].reshape(9, -1))
        assert not steps["PointDataOffsets/body"][()].any()
        assert vtk["PointData/body"] == file["particles/body"]
        np.testing.assert_array_equal(vtk["Vertices/Connectivity"], np.arange(9))
        np.testing.assert_array_equal(vtk["Vertices/Offsets"], np.arange(10))
        for name in ("Vertices", "Lines", "Polygons", "Strips"):
            cells = vtk[name]
            count = 9 if name == "Vertices" else 0
            assert cells["NumberOfCells"][0] == cells["NumberOfConnectivityIds"][0] == count
            assert len(cells["Offsets"]) == count + 1
        assert steps["CellOffsets"].shape == steps["ConnectivityIdOffsets"].shape == (FRAMES, 4)
        assert not steps["CellOffsets"][()].any()
        np.testing.assert_array_equal(steps["NumberOfParts"], np.ones(FRAMES))
        np.testing.assert_array_equal(steps["PartOffsets"], np.zeros(FRAMES))


def test_after_an_error_the_part_is_readable(tmp_path, dim):
    def fail():
        with write(tmp_path / "t.h5", dim, count=3):
            raise RunError("blew up")

    with pytest.raises(RunError):
        fail()
    back = read_trajectory(tmp_path / "t.h5")
    assert (back.complete, back.time.size) == (False, 3)
    assert read_trajectory(part_path(tmp_path / "t.h5")).time.size == 3
    np.testing.assert_array_equal(back.fields["x"][2], frame(2, dim)["x"])
    write(tmp_path / "t.h5", dim).close()  # starts over
    assert read_trajectory(tmp_path / "t.h5").complete


def test_a_short_and_an_empty_run_can_be_closed(tmp_path):
    for count in (0, 2):
        write(tmp_path / "t.h5", 2, count=count).close()
        assert read_trajectory(tmp_path / "t.h5").fields["x"].shape == (count, 9, 2)


def test_misuse_is_an_error(tmp_path):
    writer = write(tmp_path / "t.h5", 2, count=1)
    with pytest.raises(ValueError, match="frame 2 of 5 after 1"):
        writer.write(2, 0.0, **frame(2, 2))
    with pytest.raises(ValueError, match="but the file has"):
        writer.write(1, 0.0, x=frame(1, 2)["x"])
    writer.abandon()


def test_a_file_that_is_not_a_trajectory_is_refused(tmp_path):
    with pytest.raises(UsageError, match="no such trajectory"):
        read_trajectory(tmp_path / "t.h5")
    (tmp_path / "t.h5").write_bytes(b"not HDF5")
    with pytest.raises(UsageError, match="not a cqrun trajectory"):
        read_trajectory(tmp_path / "t.h5")
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["a"] = 1
    with pytest.raises(UsageError, match="not a cqrun trajectory"):
        read_trajectory(tmp_path / "t.h5")


WRITER = """
import sys
import numpy as np
from pathlib import Path
from cqrun.store.trajectory import TrajectoryWriter
n = 3000
fields = {"v": (3,), "activation": ()}
w = TrajectoryWriter(Path(sys.argv[1]), 5000, {"b": slice(0, n)}, 3, fields, {})
for k in range(5000):
    w.write(k, k / 100, x=np.full((n, 3), k), v=np.full((n, 3), -k), activation=np.full(n, k))
    print(k, flush=True)
"""


def test_killed_at_random_moments(tmp_path):
    """After each of ten SIGKILLs the file opens and has every frame for which `write` returned."""
    moments = random.Random(7)
    reached = []
    for kill in range(10):
        path = tmp_path / f"{kill}.h5"
        process = subprocess.Popen(
            [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, cwd=Path(__file__).parents[2]
        )
        assert process.stdout is not None
        first = process.stdout.readline()
        time.sleep(moments.uniform(0, 0.1))
        process.send_signal(signal.SIGKILL)
        printed = [first, *process.stdout.readlines()]
        process.stdout.close()
        assert process.wait() == -signal.SIGKILL
        returned = 1 + int([line for line in printed if line.endswith(b"\n")][-1])
        back = read_trajectory(path)
        assert not back.complete
        assert returned <= back.time.size <= returned + 1
        np.testing.assert_array_equal(back.time, np.arange(back.time.size) / 100)
        for name, sign in {"x": 1, "v": -1, "activation": 1}.items():
            data = back.fields[name].reshape(back.time.size, -1)
            expected = sign * np.arange(back.time.size, dtype=data.dtype)
            assert (data == expected[:, None]).all()
        reached.append(returned)
        part_path(path).unlink()
    assert len(set(reached)) > 3


def test_particles_know_their_group(tmp_path):
    path, groups = tmp_path / "run.h5", {"beam.tip": np.array([3, 4]), "beam.end": np.array([4])}
    with TrajectoryWriter(path, 1, {"beam": slice(0, 5)}, 2, {}, {}, groups) as writer:
        writer.write(0, 0.0, x=np.zeros((5, 2)))
    with h5py.File(path) as file:
        assert file["particles/group"][:].tolist() == [-1, -1, -1, 0, 1]
        assert json.loads(file["particles"].attrs["groups"]) == ["beam.tip", "beam.end"]
        assert file["VTKHDF/PointData/group"][:].tolist() == [-1, -1, -1, 0, 1]
    assert set(read_trajectory(path).fields) == {"x"}


def test_paraview_knows_the_format_by_a_link(tmp_path):
    path = tmp_path / "run.h5"
    for _ in range(2):  # a second run replaces the link
        with TrajectoryWriter(path, 1, {"beam": slice(0, 5)}, 2, {}, {}) as writer:
            writer.write(0, 0.0, x=np.ones((5, 2)))
    link = tmp_path / "run.vtkhdf"
    assert link.stat().st_size < 10_000
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for file in (path, link):
        file.rename(moved / file.name)
    with h5py.File(moved / "run.vtkhdf") as file:
        assert file["VTKHDF/Points"][:].shape == (5, 3)
    pyvista = pytest.importorskip("pyvista")
    assert pyvista.read(moved / "run.vtkhdf").points == pytest.approx(np.array([[1.0, 1.0, 0.0]] * 5))


def test_meshio_takes_a_frame(tmp_path):
    """As the page on files of runs says."""
    meshio = pytest.importorskip("meshio")
    path = tmp_path / "run.h5"
    with TrajectoryWriter(path, 1, {"beam": slice(0, 5)}, 2, {}, {}) as writer:
        writer.write(0, 0.0, x=np.arange(10.0).reshape(5, 2))
    x = read_trajectory(path).fields["x"][:]
    mesh = meshio.Mesh(x[-1], [("vertex", np.arange(x.shape[1])[:, None])])
    mesh.write(tmp_path / "frame.vtu")
    assert meshio.read(tmp_path / "frame.vtu").points[:, :2] == pytest.approx(x[-1])
