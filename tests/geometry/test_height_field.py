"""Terrain: heights, normals, points inside, and bounds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from cqrun.engine.setting import grid_shape, node_positions
from cqrun.errors import UsageError
from cqrun.geometry.height_field import HeightField
from cqrun.geometry.lattice import Lattice

POINTS = [[0.0, 1.0], [1.0, 2.0], [3.0, 0.5]]
HILLS = {"amplitude": 0.25, "wavelength": 2.0, "base": 0.5, "phase": 90.0}


def field(**fields: Any) -> HeightField:
    return HeightField.model_validate(fields)


def test_heights_are_linear_between_points_and_constant_beyond() -> None:
    terrain = field(points=POINTS)
    assert terrain.height(np.array([-5.0, 0.5, 1.0, 2.0, 9.0])) == pytest.approx([1.0, 1.5, 2.0, 1.25, 0.5])
    assert terrain.inside(np.array([[0.5, 1.5], [0.5, 1.51], [9.0, -100.0]])).tolist() == [True, False, True]


def test_phase_sets_the_crests_of_hills() -> None:
    terrain = field(sinusoid=HILLS)
    assert terrain.height(np.array([0.0, 1.0, 2.0, 0.5])) == pytest.approx([0.75, 0.25, 0.75, 0.5])


@pytest.mark.parametrize("terrain", [field(points=POINTS), field(sinusoid=HILLS)])
def test_normals_agree_with_finite_differences(terrain: HeightField, rng: np.random.Generator) -> None:
    x = rng.uniform(-1.0, 4.0, (100, 2))
    normal = terrain.normals(x)
    assert np.linalg.norm(normal, axis=1) == pytest.approx(np.ones(100))
    step = 1e-6
    slope = (terrain.height(x[:, 0] + step) - terrain.height(x[:, 0] - step)) / (2 * step)
    assert -normal[:, 0] / normal[:, 1] == pytest.approx(slope, abs=1e-6)


def test_in_3d_heights_are_along_the_axis_up(rng: np.random.Generator) -> None:
    flat, y, z = field(points=POINTS), field(points=POINTS, up="y"), field(points=POINTS, up="z")
    x = rng.uniform(0.0, 3.0, (200, 3))
    assert (y.inside(x) == flat.inside(x[:, :2])).all()
    assert (z.inside(x) == flat.inside(x[:, [0, 2]])).all()
    assert (z.normals(x)[:, 1] == 0).all()
    assert y.normals(x)[:, :2] == pytest.approx(flat.normals(x[:, :2]))


def test_bounds_of_terrain() -> None:
    endless = field(points=POINTS).bounds()
    assert endless[0].tolist() == [-np.inf, -np.inf]
    assert endless[1].tolist() == [np.inf, 2.0]
    with pytest.raises(UsageError, match="height_field is infinite"):
        Lattice().sample(field(points=POINTS, bottom=0.0), 0.1)
    assert field(points=POINTS, span=[1.5, 2.0]).bounds()[1].tolist() == [2.0, 1.625]
    assert field(sinusoid=HILLS, up="z").bounds()[1].tolist() == [np.inf, np.inf, 0.75]
    # a span without a crest: the highest point is an end
    assert field(sinusoid=HILLS, span=[0.2, 1.2]).bounds()[1][1] == pytest.approx(0.5 + 0.25 * np.cos(0.2 * np.pi))


def test_terrain_is_filled_up_to_its_height() -> None:
    terrain = field(sinusoid=HILLS, span=[0.0, 4.0], bottom=0.0)
    points, volume = Lattice().sample(terrain, 0.02)
    assert (points[:, 1] <= terrain.height(points[:, 0])).all()
    assert volume.sum() == pytest.approx(2.0, rel=0.01)


def test_nodes_below_the_height_are_inside() -> None:
    nodes = node_positions(grid_shape(np.array([4.0, 1.0]), 0.1), 0.1)
    below = nodes[field(sinusoid=HILLS).inside(nodes)]
    assert len(below)
    assert (below[:, 1] <= 0.5 + 0.25 * np.cos(np.pi * below[:, 0]) + 1e-12).all()
    assert below[:, 1].min() == nodes[:, 1].min()  # below the world as well


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "exactly one of points, sinusoid"),
        ({"points": POINTS, "sinusoid": HILLS}, "exactly one of points, sinusoid"),
        ({"points": [[0, 1], [0, 2]]}, "every x greater than the previous one"),
        ({"points": [[0, 1]]}, "at least 2 entries, has 1"),
        ({"points": POINTS, "span": [2, 1]}, "must begin before it ends"),
        ({"points": POINTS, "bottom": 2}, "must be below the highest point, 2 m, is 2"),
        ({"sinusoid": {**HILLS, "wavelength": 0}}, "must be greater than 0"),
    ],
)
def test_invalid_terrain_is_an_error(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError) as info:
        field(**fields)
    assert message in str(info.value)


def test_up_is_given_in_3d_only() -> None:
    assert "say whether heights are along y or z" in field(points=POINTS).dim_problems(3)[0][1]
    assert "in 2D heights are along y" in field(points=POINTS, up="y").dim_problems(2)[0][1]
    assert field(points=POINTS).dim_problems(2) == field(points=POINTS, up="y").dim_problems(3) == []
