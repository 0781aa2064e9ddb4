"""Local coordinates in the world: transformation and its inverse, rotations, infinite boxes."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from cqrun.geometry.half_space import HalfSpace
from cqrun.geometry.place import Place
from cqrun.plugin.registry import plugins

PLACES = [
    (2, Place()),
    (2, Place(scale=0.2, offset=[3.0, 4.0])),
    (2, Place(angle=-70.0, offset=[3.0, 4.0])),
    (3, Place(scale=3.0, rotation=[10.0, 20.0, -30.0], offset=[1.0, 0.0, 0.0])),
]


@pytest.mark.parametrize(("dim", "place"), PLACES)
def test_to_local_inverts_to_world(dim: int, place: Place, rng: np.random.Generator) -> None:
    x = rng.normal(size=(50, dim))
    y = place.to_world(x)
    assert place.to_local(y) == pytest.approx(x, abs=1e-14)
    # a similarity: every distance grows by the scale, and the orientation is kept
    assert np.linalg.norm(y[1:] - y[0], axis=1) == pytest.approx(place.scale * np.linalg.norm(x[1:] - x[0], axis=1))
    assert np.linalg.det((y[1 : dim + 1] - y[0]) / place.scale) == pytest.approx(np.linalg.det(x[1 : dim + 1] - x[0]))


def test_default_place_changes_no_bit(rng: np.random.Generator) -> None:
    x = rng.normal(size=(50, 3))
    assert (Place().to_world(x) == x).all()


def test_rotations_are_counterclockwise_and_right_handed() -> None:
    x = np.array([[1.0, 0.0]])
    assert Place(angle=90.0).to_world(x).tolist() == [[0.0, 1.0]]
    assert Place(angle=90.0, scale=2.0, offset=[5.0, 0.0]).to_world(x).tolist() == [[5.0, 2.0]]
    z = Place(rotation=[0.0, 0.0, 90.0]).to_world(np.array([[1.0, 0.0, 0.5]]))
    assert z == pytest.approx(np.array([[0.0, 1.0, 0.5]]))


def test_infinite_bounds_are_rotated() -> None:
    below = HalfSpace(point=[0.0, 1.0], normal=[0.0, 1.0])
    lower, upper = Place(angle=90.0).world_bounds(*below.bounds())
    assert lower.tolist() == [-1.0, -np.inf]
    assert upper.tolist() == [np.inf, np.inf]
    lower, upper = Place(angle=45.0).world_bounds(*below.bounds())
    assert np.isinf([lower, upper]).all()


def test_angle_is_for_2d_and_rotation_for_3d() -> None:
    assert Place(angle=10.0).dim_problems(2) == []
    assert "in 3D give `rotation`" in Place(angle=10.0).dim_problems(3)[0][1]
    assert Place(rotation=[1.0, 0.0, 0.0]).dim_problems(3) == []
    assert "in 2D give `angle`" in Place(rotation=[1.0, 0.0, 0.0]).dim_problems(2)[0][1]
    assert Place(offset=[1.0, 0.0]).dim_problems(3)[0][0] == ("offset",)
    with pytest.raises(ValidationError, match="must be greater than 0"):
        Place(scale=0.0)


def test_transformed_half_space_has_infinite_volume() -> None:
    cls = plugins("shape")["transformed"]
    tilted = cls.model_validate({"shape": {"half_space": {"point": [0, 0], "normal": [0, 1]}}, "angle": 30.0})
    assert tilted.volume() == np.inf
    down = np.array([[0.1, -1.0], [0.1, 1.0]])
    assert tilted.inside(down).tolist() == [True, False]
