"""The motion of rigid bodies in a trajectory, and where pictures draw them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cqrun.errors import UsageError
from cqrun.figures.rigid import corners_of, outlines, placed, silhouette
from cqrun.figures.views import PLANE
from cqrun.geometry.box import Box
from cqrun.geometry.cylinder import Cylinder
from cqrun.scene.load import load_scene
from cqrun.store.rigid_motion import RigidMotions
from cqrun.store.trajectory import TrajectoryWriter, read_trajectory


def motions(dim: int) -> RigidMotions:
    """Return the motion of two bodies in three control steps."""
    rng = np.random.default_rng(3)
    names, size = ("stone", "jaw"), 6 if dim == 2 else 12
    rows = {name: rng.normal(size=(4, size)) for name in names}
    return RigidMotions(0.1 * np.arange(4), rows, {name: rng.normal(size=dim) for name in names})


def write(path: Path, dim: int) -> RigidMotions:
    """Write a trajectory with rigid bodies."""
    found = motions(dim)
    with TrajectoryWriter(path, 1, {"body": slice(0, 2)}, dim, {}, {}) as writer:
        writer.write(0, 0.0, x=np.zeros((2, dim)), step=np.asarray(0))
        writer.add(found)
    return found


@pytest.mark.parametrize("dim", [2, 3])
def test_a_trajectory_has_the_motion_that_was_written(dim, tmp_path):
    written = write(tmp_path / "trajectory.h5", dim)
    read = read_trajectory(tmp_path / "trajectory.h5").rigid
    assert read is not None
    assert (read.time == written.time).all()
    for name in written.rows:
        assert (read.rows[name] == written.rows[name]).all()
        assert (read.center[name] == written.center[name]).all()
        assert read.part(name, "rotation").shape == (4, 2 * dim - 3)
        assert (read.part(name, "velocity") == written.rows[name][:, 3 * dim - 3 : 4 * dim - 3]).all()


def test_a_changed_number_is_noticed(tmp_path):
    import h5py

    write(tmp_path / "trajectory.h5", 2)
    with h5py.File(tmp_path / "trajectory.h5", "r+") as file:
        file["rigid/bodies/jaw/spin"][2] += 1.0
    with pytest.raises(UsageError, match="control step 2 of 'rigid/bodies/jaw/spin' is not what was written"):
        read_trajectory(tmp_path / "trajectory.h5")


def test_outlines_follow_the_motion():
    """A box turned by a quarter about its centre, and moved."""
    material = {"density": 1, "elastic": {"neo_hookean": {"youngs_modulus": 1, "poissons_ratio": 0}}}
    block = {
        "shape": {"box": {"corner": [0.1, 0.1], "size": [0.2, 0.2]}},
        "particles_per_cell": 4,
        "material": material,
    }
    jaw = {"shape": {"box": {"corner": [0.5, 0.5], "size": [0.2, 0.1]}}}
    ground = {"shape": {"half_space": {"point": [0, 0.05], "normal": [0, 1]}}}
    scene = load_scene({
        "cqrun": 1, "world": {"size": [1, 1], "dx": 0.1}, "bodies": {"a": block},
        "rigid": {"jaw": jaw, "ground": ground}, "time": {"duration": 1, "control_step": 1},
    })  # fmt: skip
    still = np.zeros((2, 6))
    still[1, :3] = 0.1, 0.2, np.pi / 2
    moved = RigidMotions(np.arange(2.0), {"jaw": still}, {"jaw": np.array([0.6, 0.55])})
    (before,), (after,) = (outlines(scene, moved, step, PLANE) for step in (0, 1))
    np.testing.assert_allclose([before.min(axis=0), before.max(axis=0)], [[0.5, 0.5], [0.7, 0.6]])
    np.testing.assert_allclose([after.min(axis=0), after.max(axis=0)], [[0.65, 0.65], [0.75, 0.85]])


def test_a_mesh_is_drawn_with_its_dents_and_holes(tmp_path):
    """A bent and a closed frame: the outline encloses what is there, to the image's pixels."""
    trimesh = pytest.importorskip("trimesh")
    ring = trimesh.creation.annulus(r_min=0.1, r_max=0.15, height=0.04)
    half = trimesh.intersections.slice_mesh_plane(ring, [1, 0, 0], [0, 0, 0])  # open, which a picture does not mind
    for mesh, area in ((ring, np.pi * (0.15**2 - 0.1**2)), (half, np.pi / 2 * (0.15**2 - 0.1**2))):
        (outline,) = silhouette(np.array(mesh.triangles)[..., :2])
        x, y = outline.T
        assert 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) == pytest.approx(area, rel=0.03)
        low, high = mesh.bounds[:, :2]
        np.testing.assert_allclose([outline.min(axis=0), outline.max(axis=0)], [low, high], atol=1.5e-3)


@pytest.mark.parametrize(
    "shape",
    [
        Box(corner=[0.1, 0.2, 0.3], size=[0.1, 0.2, 0.3]),
        Cylinder(start=[0.1, 0.1, 0.1], end=[0.1, 0.1, 0.5], radius=0.2),
    ],
)
def test_corners_lie_on_the_surface_and_reach_its_bounds(shape):
    (solid,) = shape.solids()
    x = corners_of(solid)
    np.testing.assert_allclose([x.min(axis=0), x.max(axis=0)], shape.bounds(), atol=1e-12)
    assert np.allclose(placed(x, np.zeros(12), np.zeros(3)), x)
