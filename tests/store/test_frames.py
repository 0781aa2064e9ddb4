"""Read a trajectory frame by frame: finished, being written, or damaged."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from cqrun.errors import UsageError
from cqrun.store.frames import Frames
from cqrun.store.hdf5 import HEAP, require_sound_heaps
from cqrun.store.trajectory import TrajectoryWriter, read_trajectory


def write(path, frames, abandon=False):
    bodies, provenance = {"a": slice(0, 2), "b": slice(2, 5)}, {"seed": 3}
    writer = TrajectoryWriter(path, 4, bodies, 2, {"J": ()}, provenance)
    for k in range(frames):
        writer.write(k, 0.1 * k, x=np.full((5, 2), float(k)), J=np.full(5, 1.0 + k), step=np.asarray(3 * k))
    (writer.abandon if abandon else writer.close)()


@pytest.mark.parametrize("abandon", [False, True])
def test_frames_are_read_one_by_one(tmp_path, abandon):
    write(tmp_path / "t.h5", 3, abandon)
    with Frames(tmp_path / "t.h5") as frames:
        assert len(frames) == 3
        assert frames.complete is not abandon
        assert frames.path.name == ("t.h5.part" if abandon else "t.h5")
        assert (frames.fields, frames.bodies) == (("J", "x"), {"a": slice(0, 2), "b": slice(2, 5)})
        assert frames.provenance == {"seed": 3}
        np.testing.assert_array_equal(frames.step, [0, 3, 6])
        np.testing.assert_array_equal(frames.read("x", 2), np.full((5, 2), 2.0))
        np.testing.assert_array_equal(frames.read_all("J"), read_trajectory(tmp_path / "t.h5").fields["J"])


def test_missing_and_damaged_trajectories_are_refused(tmp_path):
    with pytest.raises(UsageError, match="no such trajectory"):
        Frames(tmp_path / "t.h5")
    write(tmp_path / "t.h5", 2)
    with Frames(tmp_path / "t.h5") as frames, pytest.raises(UsageError, match="not a cqrun trajectory"):
        frames.read("F", 0)
    content = (tmp_path / "t.h5").read_bytes()
    (tmp_path / "t.h5").write_bytes(content[: len(content) // 2])
    with pytest.raises(UsageError, match="truncated"):
        Frames(tmp_path / "t.h5")


@pytest.mark.parametrize(
    ("place", "value"),
    [("bodies", "[1, 2]"), ("bodies", '{"a": [0]}'), ("bodies", 3), ("provenance", "[1]"), ("provenance", "{")],
)
def test_what_it_says_of_itself_may_be_damaged(tmp_path, place, value):
    write(tmp_path / "t.h5", 2)
    with h5py.File(tmp_path / "t.h5", "a") as file:
        (file if place == "provenance" else file["particles"]).attrs[place] = value
    with pytest.raises(UsageError, match="not a cqrun trajectory, or damaged"):
        Frames(tmp_path / "t.h5")


def test_a_field_that_claims_more_than_the_file_holds(tmp_path):
    write(tmp_path / "t.h5", 2)
    with h5py.File(tmp_path / "t.h5", "a") as file:
        file.create_dataset("particles/huge", (2, 10**9), dtype="f8", chunks=(1, 10**6), compression="gzip")
    with pytest.raises(UsageError, match=r"'huge' claims 14\.9 GiB"):
        Frames(tmp_path / "t.h5")


@pytest.mark.parametrize(("name", "shape"), [("time", (1,)), ("particles/x", (2, 4, 2)), ("particles/J", ())])
def test_a_field_with_fewer_frames_or_particles_than_the_file_announces(tmp_path, name, shape):
    write(tmp_path / "t.h5", 2)
    with h5py.File(tmp_path / "t.h5", "a") as file:
        del file[name]
        file[name] = np.zeros(shape)
    with pytest.raises(UsageError, match=rf"'/{name}' is of shape"):
        Frames(tmp_path / "t.h5")


@pytest.mark.parametrize("abandon", [False, True])
@pytest.mark.parametrize("size", [0, 5, 0xFF, 1 << 40])
def test_damaged_heaps_of_texts_are_refused(tmp_path, abandon, size):
    """HDF5 looks for their end for ever, and no signal is heard meanwhile."""
    write(tmp_path / "t.h5", 2, abandon)
    path = tmp_path / ("t.h5.part" if abandon else "t.h5")
    require_sound_heaps(path)
    data = bytearray(path.read_bytes())
    at = data.index(HEAP) + 16
    while data[at : at + 2] != b"\0\0":  # to the free rest
        at += 16 + -(-int.from_bytes(data[at + 8 : at + 16], "little") // 8) * 8
    data[at + 8 : at + 16] = size.to_bytes(8, "little")
    path.write_bytes(bytes(data))
    with pytest.raises(UsageError, match="a heap of texts is damaged"):
        Frames(tmp_path / "t.h5")
