"""Read a trajectory frame by frame: finished, being written, or damaged."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.errors import UsageError
from cqrun.store.frames import Frames
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
