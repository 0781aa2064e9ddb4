"""Fitted lattices: particles have the volumes and the centres of the parts of a shape that are nearest to them."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cqrun.geometry.lattice import Lattice
from cqrun.geometry.shape import Shape
from cqrun.plugin.contract import Array
from cqrun.plugin.registry import plugins


def shape(name: str, **fields: Any) -> Shape:
    value: Shape = plugins("shape")[name].model_validate(fields)
    return value


def hollow(dim: int) -> Shape:
    """Return a ring, or a hollow ball, with a wall of 80 mm."""
    return shape("difference", shapes=[{"ball": {"center": [0.5] * dim, "radius": r}} for r in (0.38, 0.3)])


TAPER = {"start_radius": 0.05, "end_radius": 0.02}
SHAPES: dict[str, tuple[Shape, float, float]] = {
    "ring": (hollow(2), np.pi * (0.38**2 - 0.3**2), 2 * np.pi * 0.68),
    "hollow ball": (hollow(3), 4 / 3 * np.pi * (0.38**3 - 0.3**3), 4 * np.pi * (0.38**2 + 0.3**2)),
    "ball": (shape("ball", center=[0.1, 0.2, 0.3], radius=0.1), 4 / 3 * np.pi * 1e-3, 4 * np.pi * 0.01),
    "cone": (shape("cone", start=[0, 0, 0], end=[0.3, 0, 0], **TAPER), np.pi * 0.3 * 1.3e-3, np.pi * 0.3 * 0.07),
    "trapezoid": (shape("cone", start=[0, 0], end=[0.3, 0], **TAPER), 0.3 * 0.07, 0.74),
    "thin wall": (shape("box", corner=[0, 0, 0], size=[0.3, 0.3, 0.0417]), 0.3 * 0.3 * 0.0417, 0.23),
    "plate": (shape("box", corner=[0, 0], size=[0.3, 0.0417]), 0.3 * 0.0417, 0.6834),
}
"""Shapes with their volumes and surfaces."""


@pytest.mark.parametrize("centered", [False, True])
@pytest.mark.parametrize("spacing", [0.02, 0.0173, 0.0107])
@pytest.mark.parametrize("name", SHAPES)
def test_volumes_sum_to_that_of_the_shape(name: str, spacing: float, centered: bool) -> None:
    """Flat faces are found to 1/32 of a cell in 3D and 1/68 in 2D; a plain lattice errs by up to half a cell."""
    body, volume, surface = SHAPES[name]
    x, parts = Lattice(fitted=True, centered=centered).sample(body, spacing)
    assert abs(parts.sum() - volume) < spacing / (68 if x.shape[1] == 2 else 32) * surface
    assert (parts > 0).all()
    assert body.inside(x).all()
    again, same = Lattice(fitted=True, centered=centered).sample(body, spacing)
    assert (again == x).all()
    assert (same == parts).all()


def test_particles_of_a_plain_lattice_have_another_volume() -> None:
    body, volume, _ = SHAPES["thin wall"]
    assert Lattice().sample(body, 0.0173)[1].sum() < 0.8 * volume
    assert Lattice(fitted=True).sample(body, 0.0173)[1].sum() == pytest.approx(volume, rel=0.01)


@pytest.mark.parametrize("name", ["ring", "ball", "cone"])
def test_parts_are_those_nearest_to_the_particles(name: str, rng: np.random.Generator) -> None:
    """Compare with a count of random points."""
    body, _, _ = SHAPES[name]
    own = Lattice().sample(body, 0.02)[0]
    x, parts = Lattice(fitted=True).sample(body, 0.02)
    lower, upper = body.bounds()
    points = rng.uniform(lower, upper, (1000 * int(np.prod((upper - lower) / 0.02)), len(lower)))
    density = len(points) / np.prod(upper - lower)
    points = points[body.inside(points)]
    _, at = cKDTree(own).query(points)
    count = np.bincount(at, minlength=len(own))
    volume = count / density
    centre = np.stack([np.bincount(at, axis, len(own)) for axis in points.T], axis=1) / count[:, None]
    assert np.abs(parts - volume).max() < 0.15 * 0.02 ** len(lower)
    assert np.abs(x - centre).max() < 0.1 * 0.02


def symmetric(x: Array, volume: Array, center: Array) -> bool:
    """Return whether particles are their own mirror images across each plane through a centre."""
    near = cKDTree(x)
    for signs in itertools.product((1, -1), repeat=x.shape[1]):
        distance, image = near.query(center + np.array(signs) * (x - center))
        if distance.max() > 1e-12 or np.abs(volume[image] / volume - 1).max() > 1e-9:
            return False
    return True


@pytest.mark.parametrize("name", ["ring", "hollow ball", "ball", "plate", "thin wall"])
def test_a_symmetric_body_is_sampled_symmetrically(name: str) -> None:
    body, _, _ = SHAPES[name]
    middle = np.mean(body.bounds(), axis=0)
    assert symmetric(*Lattice(fitted=True, centered=True).sample(body, 0.0173), middle)


def test_a_box_of_whole_cells_has_the_particles_of_a_plain_lattice() -> None:
    box = shape("box", corner=[0.1, 0.2, 0.3], size=[0.1, 0.06, 0.04])
    plain, fitted = (Lattice(fitted=fitted).sample(box, 0.02) for fitted in (False, True))
    assert fitted[0] == pytest.approx(plain[0], abs=1e-15)
    assert fitted[1] == pytest.approx(plain[1], rel=1e-12)


def test_cells_of_a_count_are_fitted_although_they_are_no_cubes() -> None:
    body, volume, _ = SHAPES["cone"]
    x, parts = Lattice(fitted=True, count=12).sample(body, None)
    assert parts.sum() == pytest.approx(volume, rel=0.005)
    assert (parts @ x / parts.sum())[1:] == pytest.approx([0, 0], abs=1e-12)


def test_what_is_far_from_all_particles_belongs_to_none() -> None:
    """A fin of a fifth of a cell between two columns of cells: its volume is missing, of which `validate` warns."""
    fin = {"box": {"corner": [0.0, 0.04], "size": [0.004, 0.2]}}
    body = shape("union", shapes=[{"box": {"corner": [0.0, 0.0], "size": [0.2, 0.04]}}, fin])
    _, parts = Lattice(fitted=True).sample(body, 0.02)
    assert parts.sum() == pytest.approx(0.2 * 0.04 + 0.004 * 0.02, rel=0.01)
