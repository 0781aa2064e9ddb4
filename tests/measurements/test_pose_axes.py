"""Where the axes of recorded poses lie: a rotation and an offset, given or unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_arm import NOISE, TRUE, E, problem_of, recording, scene_of, write_poses
from small_beam import result_of

from cqrun.errors import SceneError
from cqrun.jobs.sysid import run_sysid
from cqrun.jobs.validate import validate
from cqrun.scene.load import load_scene

OFFSET, ANGLE = (1.5e-3, -0.8e-3), 0.07
OFFSETS = [f"data.recordings.arm.offset.{k}" for k in range(2)]
TURN = "data.recordings.arm.rotation.0"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with recorded poses, in the long form and in the wide one."""
    write_poses(tmp_path / "poses.csv")
    write_poses(tmp_path / "wide.csv", wide=True, unit="mm", seed=2)
    return tmp_path


def test_the_axes_of_a_recording_are_found(folder):
    """Its cameras were turned by 4 degrees about the origin of their file, and moved."""
    write_poses(folder / "turned.csv", offset=OFFSET, rotation=ANGLE, seed=4)
    unknowns = f"""\
  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}
  {TURN}: {{bounds: [-0.3, 0.3]}}
  {OFFSETS[0]}: {{bounds: [-0.01, 0.01]}}
  {OFFSETS[1]}: {{bounds: [-0.01, 0.01]}}
"""
    scene = scene_of(folder, recording("arm", "turned.csv"), unknowns)
    result = result_of(run_sysid(scene, [], folder / "out", threads=1))
    for path, truth in zip((E, TURN, *OFFSETS), (TRUE, ANGLE, *OFFSET), strict=True):
        low, high = result["unknowns"][path]["interval"]
        assert low < truth < high, path
    assert result["recordings"]["arm"]["rmse_mm"] < 0.06
    given = scene_of(folder, recording("arm", "turned.csv", rotation=f"[{ANGLE}]", offset=str(list(OFFSET))))
    assert any("given for this recording alone: offset, rotation" in line for line in validate(given))
    (turned,) = problem_of(given).cases[0].compared({})
    (straight,) = problem_of(scene_of(folder, recording())).cases[0].compared({})
    np.testing.assert_allclose(turned.data, straight.data, atol=5 * NOISE)


def test_positions_without_an_axis_cannot_be_turned(folder):
    wide = [line.split(",") for line in (folder / "wide.csv").read_text().splitlines()]
    left = [k for k, name in enumerate(wide[0]) if not name.endswith("_y_mm")]
    (folder / "flat.csv").write_text("\n".join(",".join(line[k] for k in left) for line in wide))
    message = r"needs all axes of each marker, and the file leaves some out: remove `rotation`"
    problem_of(scene_of(folder, recording("arm", "flat.csv")))
    with pytest.raises(SceneError, match=message):
        problem_of(scene_of(folder, recording("arm", "flat.csv", rotation="[0.1]")))
    unknowns = f"  {E}: {{bounds: [5.0e4, 4.0e5], scale: log}}\n  {TURN}: {{bounds: [-0.3, 0.3]}}\n"
    with pytest.raises(SceneError, match=message):
        problem_of(scene_of(folder, recording("arm", "flat.csv"), unknowns))


def test_a_rotation_has_as_many_entries_as_the_world_has_rotations(folder):
    scene = scene_of(folder, recording(rotation="[0.1, 0, 0]"))
    with pytest.raises(SceneError, match=r"rotation: must have one entry in this 2D world, has 3"):
        load_scene(scene)
