"""The surface found from the test of what is inside: true, closed, oriented, with its edges and corners."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.boundaries.solid import make_solids, signed_distance
from cqrun.geometry.ball import Ball
from cqrun.geometry.box import Box
from cqrun.geometry.capsule import Capsule
from cqrun.geometry.cone import Cone
from cqrun.geometry.cylinder import Cylinder
from cqrun.geometry.difference import Difference
from cqrun.geometry.polygon import Polygon
from cqrun.geometry.shape import Shape
from cqrun.geometry.skin import Skin, make_skin
from cqrun.geometry.union import Union
from cqrun.plugin.choice import Chosen

H = 0.05


def chosen(*shapes: Shape) -> list:
    """Return shapes as fields of another one."""
    return [Chosen(shape.name, shape) for shape in shapes]


SHAPES = {
    "box, 2D": (Box(corner=[0.1, 0.2], size=[0.3, 0.2]), 1.0, 0.06),
    "box": (Box(corner=[0.1, 0.2, 0.0], size=[0.3, 0.2, 0.17]), 0.29, 0.0102),
    "disc": (Ball(center=[0.1, 0.2], radius=0.3), 0.6 * np.pi, 0.09 * np.pi),
    "ball": (Ball(center=[0.1, 0.2, 0.3], radius=0.3), 0.36 * np.pi, 0.036 * np.pi),
    "capsule": (Capsule(start=[0, 0, 0], end=[0.3, 0.4, 0.5], radius=0.2), None, None),
    "cylinder": (Cylinder(start=[0, 0, 0], end=[0, 0.4, 0.1], radius=0.2), None, None),
    "cone": (Cone(start=[0, 0, 0], end=[0, 0.4, 0.1], start_radius=0.22, end_radius=0.18), None, None),
    "polygon": (Polygon(points=[[0, 0], [1, 0.2], [0.8, 0.9], [0.3, 0.5]]), None, 0.435),
    "two boxes": (
        Union(shapes=chosen(Box(corner=[0, 0], size=[0.4, 0.1]), Box(corner=[0.3, 0], size=[0.1, 0.4]))), 1.6, 0.07,
    ),
    "tube": (Difference(shapes=chosen(Ball(center=[0, 0], radius=0.3), Ball(center=[0, 0], radius=0.15))),
             0.9 * np.pi, 0.0675 * np.pi),
}  # fmt: skip
EACH = pytest.mark.parametrize("name", SHAPES)


def skin_of(shape: Shape) -> Skin:
    """Return a shape's surface."""
    return make_skin(shape.inside, *shape.bounds(), H)


def normals(skin: Skin) -> np.ndarray:
    """Return the normals of facets, as long as their areas are large (T, D)."""
    corner = skin.x[skin.facets]
    edge = corner[:, 1] - corner[:, 0]
    if corner.shape[2] == 2:
        return np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    return 0.5 * np.cross(edge, corner[:, 2] - corner[:, 0])


@EACH
def test_points_lie_on_the_surface(name):
    """A step of 1e-6 cells in the direction of the mean normal leaves the shape, and one back enters it."""
    shape, *_ = SHAPES[name]
    skin = skin_of(shape)
    mean = np.zeros(skin.x.shape)
    for column in skin.facets.T:
        np.add.at(mean, column, normals(skin))
    step = 1e-6 * H * mean / np.linalg.norm(mean, axis=1, keepdims=True)
    assert shape.inside(skin.x - step).all()
    assert not shape.inside(skin.x + step).any()


@EACH
def test_facets_are_closed_and_face_outward(name):
    shape, area, volume = SHAPES[name]
    skin, dim = skin_of(shape), len(shape.bounds()[0])
    n, centre = normals(skin), skin.x[skin.facets].mean(axis=1)
    np.testing.assert_allclose(n.sum(axis=0), 0.0, atol=1e-13)
    enclosed = float(np.einsum("td,td->", centre, n) / dim)
    assert enclosed == pytest.approx(shape.volume() if volume is None else volume, rel=0.03)
    assert skin.area.sum() == pytest.approx(np.linalg.norm(n, axis=1).sum(), rel=1e-12)
    if area is not None:
        assert skin.area.sum() == pytest.approx(area, rel=0.01)
    assert skin.area.max() < 1.5 * H ** (dim - 1)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_has_a_regular_lattice_with_its_corners(dim):
    """Points at multiples of the spacing, symmetric, each with the area of a cell of the lattice but at edges."""
    shape = Box(corner=[0.1, 0.2, 0.3][:dim], size=[0.2, 0.1, 0.15][:dim])
    skin = skin_of(shape)
    cells = (skin.x - shape.bounds()[0]) / H
    np.testing.assert_allclose(cells, np.rint(cells), atol=1e-7)
    counts = [4, 2, 3][:dim]
    assert len(skin.x) == np.prod(np.add(counts, 1)) - np.prod(np.subtract(counts, 1))
    on = np.isclose(cells, 0) | np.isclose(cells, counts)
    if dim == 3:
        expected = np.select([on.sum(axis=1) == k for k in (1, 2, 3)], [1.0, 1.0, 0.75])
        np.testing.assert_allclose(skin.area / H**2, expected, rtol=1e-6)
    else:
        np.testing.assert_allclose(skin.area / H, 1.0, rtol=1e-6)


def test_a_turned_box_keeps_its_corners():
    corners = np.array([[0.0, 0.0], [0.4, 0.3], [0.28, 0.46], [-0.12, 0.16]])
    skin = skin_of(Polygon(points=corners.tolist()))
    for corner in corners:
        assert np.linalg.norm(skin.x - corner, axis=1).min() < 1e-6


@pytest.mark.parametrize("radii", [(0.1, 0.25), (0.25, 0.1)])
def test_points_at_a_sharp_rim_lie_on_the_surface(radii):
    cone = Cone(start=[0, 0, 0], end=[0, 0.4, 0.1], start_radius=radii[0], end_radius=radii[1])
    table = make_solids(cone.solids())
    away = [abs(signed_distance(table, 0, tuple(x))[0]) for x in skin_of(cone).x]
    assert max(away) < 1e-7 * H
