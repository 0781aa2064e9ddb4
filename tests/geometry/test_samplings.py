"""Samplings: positions and volumes of particles, which are deterministic."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError
from scipy.spatial import cKDTree

from cqrun.errors import UsageError
from cqrun.geometry.box import Box
from cqrun.geometry.shape import Shape
from cqrun.plugin.registry import plugins


def make(kind: str, name: str, **fields: Any) -> Any:
    return plugins(kind)[name].model_validate(fields)


@pytest.fixture
def box() -> Box:
    return Box(corner=[0.1, 0.2], size=[0.4, 0.2])


def chain() -> Shape:
    boxes = [{"box": {"corner": [x, 0.0], "size": [1.0, 1.0]}} for x in (0.0, 0.5, 1.5)]
    return make("shape", "union", shapes=boxes)


def test_lattice_points_are_at_half_spacings_from_the_corner(box: Box) -> None:
    points, volume = make("sampling", "lattice").sample(box, 0.1)
    assert points == pytest.approx(np.array([[x, y] for x in (0.15, 0.25, 0.35, 0.45) for y in (0.25, 0.35)]))
    assert volume == pytest.approx(np.full(8, 0.01))
    assert volume.sum() == pytest.approx(box.volume())


def test_union_on_one_lattice_samples_overlaps_once() -> None:
    points, volume = make("sampling", "lattice").sample(chain(), 0.25)
    assert len(points) == 40
    assert len(np.unique(points.round(9), axis=0)) == 40
    assert volume.sum() == pytest.approx(2.5)


def test_lattice_in_a_scaled_union_is_scaled() -> None:
    local = chain()
    parts = local.model_dump()["shapes"]
    world = make("shape", "union", shapes=[{"union": parts}], scale=0.2, offset=[3, 4])
    a, va = make("sampling", "lattice").sample(local, 0.25)
    b, vb = make("sampling", "lattice").sample(world, 0.05)
    assert b == pytest.approx(0.2 * a + [3, 4])
    assert vb == pytest.approx(0.04 * va)


def test_jitter_stays_in_its_cell_and_is_deterministic(box: Box) -> None:
    regular, _ = make("sampling", "lattice").sample(box, 0.05)
    moved, volume = make("sampling", "jittered", amount=0.5, seed=3).sample(box, 0.05)
    assert 0.01 < np.abs(moved - regular).max() <= 0.25 * 0.05
    assert volume.sum() == pytest.approx(box.volume())
    again, _ = make("sampling", "jittered", amount=0.5, seed=3).sample(box, 0.05)
    other, _ = make("sampling", "jittered", amount=0.5, seed=4).sample(box, 0.05)
    assert (moved == again).all()
    assert (moved != other).any()
    still, _ = make("sampling", "jittered", amount=0.0).sample(box, 0.05)
    assert (still == regular).all()


def test_random_is_uniform_in_the_shape_and_shares_its_volume() -> None:
    ball = make("shape", "ball", center=[1, 2, 3], radius=0.5)
    points, volume = make("sampling", "random", count=20_000, seed=1).sample(ball, None)
    assert points.shape == (20_000, 3)
    assert ball.inside(points).all()
    assert volume.sum() == pytest.approx(ball.volume())
    # uniform in a ball: the mean squared distance from the centre is 3/5 r^2
    assert ((points - [1, 2, 3]) ** 2).sum(axis=1).mean() == pytest.approx(0.6 * 0.25, rel=0.02)
    again, _ = make("sampling", "random", count=20_000, seed=1).sample(ball, None)
    assert (points == again).all()


@pytest.mark.parametrize("sampling", [make("sampling", "lattice"), make("sampling", "random", count=9)])
def test_infinite_and_empty_shapes_are_errors(sampling: Any) -> None:
    with pytest.raises(UsageError, match="half_space is infinite"):
        sampling.sample(make("shape", "half_space", point=[0, 0], normal=[0, 1]), 0.1)
    apart = [{"ball": {"center": [x, 0], "radius": 0.4}} for x in (0, 1)]
    with pytest.raises(UsageError, match="intersection is empty"):
        sampling.sample(make("shape", "intersection", shapes=apart), 0.1)


def test_far_too_small_spacing_is_an_error(box: Box) -> None:
    with pytest.raises(UsageError, match="check the units"):
        make("sampling", "lattice").sample(box, 1e-6)


def test_empty_difference_is_an_error() -> None:
    hollow = make("shape", "difference", shapes=[{"ball": {"center": [0, 0], "radius": r}} for r in (1, 2)])
    with pytest.raises(UsageError, match="is it empty"):
        make("sampling", "random", count=9).sample(hollow, None)


@pytest.mark.parametrize(("dim", "spacing", "nearest"), [(2, 0.03, 0.78), (3, 0.15, 0.84)])
def test_poisson_disks_keep_their_distance_and_are_about_as_many_as_on_a_lattice(
    dim: int, spacing: float, nearest: float
) -> None:
    ball = make("shape", "ball", center=[1.0] * dim, radius=0.5)
    points, volume = make("sampling", "poisson_disk", seed=2).sample(ball, spacing)
    assert ball.inside(points).all()
    distance = np.linalg.norm(points[:, None] - points, axis=2) + 9.0 * np.eye(len(points))
    assert nearest * spacing <= distance.min() < 1.02 * nearest * spacing
    assert len(points) == pytest.approx(ball.volume() / spacing**dim, rel=0.1)
    assert volume.sum() == pytest.approx(ball.volume())
    again, _ = make("sampling", "poisson_disk", seed=2).sample(ball, spacing)
    other, _ = make("sampling", "poisson_disk", seed=3).sample(ball, spacing)
    assert (points == again).all()
    assert len(other) != len(points) or (other != points).any()


def test_poisson_disks_fill_a_long_box(box: Box) -> None:
    points, _ = make("sampling", "poisson_disk").sample(box, 0.02)
    assert box.inside(points).all()
    assert np.ptp(points, axis=0) == pytest.approx([0.4, 0.2], abs=0.02)
    with pytest.raises(UsageError, match=r"about 5.56e\+04 particles around the box .*use `jittered`"):
        make("sampling", "poisson_disk").sample(box, 0.0012)


def tapered(path: Path) -> Shape:
    """Return a cone frustum along x, whose diameter of 39 mm is no multiple of 5 mm, as a mesh."""
    turn = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    ends = [np.column_stack([np.full(64, x), radius * ring]) for x, radius in ((0.0, 0.0195), (0.101, 0.006))]
    trimesh.Trimesh(np.concatenate(ends)).convex_hull.export(path)
    return make("shape", "mesh", file=str(path), offset=[0.05, 0.05, 0.05])


def mirrored(points: np.ndarray, axis: int) -> bool:
    """Return whether points mirrored at 0.05 m are the same points."""
    other = points.copy()
    other[:, axis] = 0.1 - other[:, axis]
    return bool(cKDTree(points).query(other)[0].max() < 1e-9)


def test_centered_lattice_in_a_tapered_mesh_is_symmetric_about_its_axis(tmp_path: Path) -> None:
    cone = tapered(tmp_path / "cone.stl")
    lopsided, _ = make("sampling", "lattice").sample(cone, 0.005)
    points, volume = make("sampling", "lattice", centered=True).sample(cone, 0.005)
    for axis in (1, 2):
        assert not mirrored(lopsided, axis)
        assert mirrored(points, axis)
    tip = points[points[:, 0] > 0.13]
    assert tip[:, 1:].mean(axis=0) == pytest.approx([0.05, 0.05], abs=1e-9)
    assert np.abs(lopsided[lopsided[:, 0] > 0.13][:, 1:].mean(axis=0) - 0.05).max() > 0.0004
    assert volume == pytest.approx(np.full(len(points), 0.005**3))
    layers = (points[:, 0] - 0.1005) / 0.005  # 21 along x, so one of them is in the middle; an STL has float32
    assert np.abs(layers - np.round(layers)).max() < 1e-6


def test_centered_lattice_of_a_whole_number_of_cells_is_the_same(box: Box) -> None:
    plain, _ = make("sampling", "lattice").sample(box, 0.1)
    assert make("sampling", "lattice", centered=True).sample(box, 0.1)[0] == pytest.approx(plain, abs=1e-12)


def test_centered_has_no_effect_with_a_count() -> None:
    with pytest.raises(ValidationError, match="has no effect with a count, whose cells fill the bounds evenly"):
        make("sampling", "lattice", count=3, centered=True)
    assert "centered" not in make("sampling", "lattice").model_dump()  # so that runs keep their names
