"""Shapes: points inside, bounds, and volumes compared with a count of random points."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from cqrun.boundaries.solid import make_solids, signed_distance
from cqrun.errors import UsageError
from cqrun.geometry.shape import Shape
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.registry import plugins

DISC = {"ball": {"center": [0, 1], "radius": 1}}
SQUARE = {"box": {"corner": [0, 1], "size": [1, 1]}}
SPHERE = {"ball": {"center": [0, 0, 0], "radius": 1}}
BELOW = {"half_space": {"point": [0, 0, 0.25], "normal": [0, 0, 2]}}
BAR = {"start": [0, 0, 0], "end": [1, 0.5, 0.2], "radius": 0.3}
TAPER = {"start": [0, 0, 0], "end": [1, 0.5, 0.2], "start_radius": 0.3, "end_radius": 0.1}
HILLS = {"amplitude": 0.25, "wavelength": 1.0, "base": 0.5}
CASES: dict[str, tuple[int, dict[str, Any]]] = {
    "box": (3, {"box": {"corner": [0.1, 0, -1], "size": [1, 2, 0.5]}}),
    "rectangle": (2, {"box": {"corner": [0.1, 0], "size": [1, 2]}}),
    "ball": (3, {"ball": {"center": [1, 2, 3], "radius": 0.5}}),
    "disc": (2, {"ball": {"center": [1, 2], "radius": 0.5}}),
    "capsule": (3, {"capsule": BAR}),
    "stadium": (2, {"capsule": {"start": [0, 0], "end": [1, 0.5], "radius": 0.3}}),
    "tapered capsule": (3, {"capsule": {**BAR, "end_radius": 0.1}}),
    "tapered stadium": (2, {"capsule": {"start": [0, 0], "end": [1, 0.5], "radius": 0.1, "end_radius": 0.4}}),
    "sweep": (3, {"sweep": {"points": [[0, 0, 0], [1, 0.5, 0.2], [1.5, 1.5, 0]], "radii": [0.3, 0.2, 0.1]}}),
    "chain": (2, {"sweep": {"points": [[0, 0], [1, 0], [1, 1]], "radii": [0.2], "curve": "straight"}}),
    "cylinder": (3, {"cylinder": BAR}),
    "cone": (3, {"cone": TAPER}),
    "trapezoid": (2, {"cone": {"start": [0, 0], "end": [1, 0.5], "start_radius": 0.1, "end_radius": 0.3}}),
    "polygon": (2, {"polygon": {"points": [[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]}}),
    "union": (2, {"union": [DISC, SQUARE]}),
    "scaled": (2, {"union": {"shapes": [DISC], "scale": 0.2, "offset": [3, 4]}}),
    "turned": (
        2,
        {"transformed": {"shape": SQUARE, "angle": 30, "offset": [1, 2], "scale": 2}},
    ),
    "turned in space": (
        3,
        {"transformed": {"shape": {"box": {"corner": [0, 0, 0], "size": [2, 1, 1]}}, "rotation": [0, 40, 20]}},
    ),
    "nested": (2, {"transformed": {"shape": {"transformed": {"shape": DISC, "angle": 90}}, "offset": [3, 0]}}),
    "terrain": (2, {"height_field": {"points": [[0, 1], [1, 2], [3, 0.5]], "span": [-1, 2], "bottom": 0}}),
    "hills": (2, {"height_field": {"sinusoid": HILLS, "span": [0.2, 2.7], "bottom": -1}}),
    "valley": (
        3,
        {
            "intersection": [
                {"height_field": {"sinusoid": {**HILLS, "phase": 90}, "span": [0.2, 0.8], "bottom": -1, "up": "z"}},
                {"box": {"corner": [-5, 1, -5], "size": [10, 1, 10]}},
            ]
        },
    ),
    "difference": (2, {"difference": [{"box": {"corner": [-1, 0], "size": [2, 1]}}, DISC]}),
    "intersection": (3, {"intersection": [SPHERE, BELOW]}),
}
EXACT = {"turned": 4.0, "turned in space": 2.0, "nested": np.pi}
EXACT |= {"terrain": 1 + 1.5 + 1.625, "hills": 2.5 * 1.5 + 0.25 / (2 * np.pi) * np.cos(0.4 * np.pi) * 2}
EXACT |= {"chain": 2 * 0.4 - 0.2**2 + np.pi / 4 * 0.2**2}
EXACT |= {"cone": np.pi / 3 * 0.13 * np.sqrt(1.29), "trapezoid": 0.4 * np.sqrt(1.25)}
EXACT |= {"scaled": 0.04 * np.pi, "polygon": 3.0, "difference": 2 - np.pi / 2, "union": 1 + 0.75 * np.pi}


def shape(data: dict[str, Any]) -> Shape:
    value: Shape = TypeAdapter(Annotated[Chosen[Shape], Choice("shape")]).validate_python(data).value
    return value


def test_every_shape_has_a_case() -> None:
    elsewhere = {"half_space", "image", "mesh"}  # tested in other files
    assert set(plugins("shape")) == {next(iter(data)) for _, data in CASES.values()} | elsewhere


@pytest.mark.parametrize("name", CASES)
def test_bounds_are_tight_and_volume_agrees_with_a_count(name: str, rng: np.random.Generator) -> None:
    dim, data = CASES[name]
    body = shape(data)
    lower, upper = body.bounds()
    assert lower.shape == upper.shape == (dim,)
    margin = 0.3 * (upper - lower)
    points = rng.uniform(lower - margin, upper + margin, (200_000, dim))
    inside = body.inside(points)
    assert inside.shape == (200_000,)
    assert inside.dtype == bool
    contained = points[inside]
    assert (contained >= lower).all()
    assert (contained <= upper).all()
    # 2D shapes reach their bounds closely; in 3D few points fall near a pole
    assert np.allclose(contained.min(axis=0), lower, atol=0.06 * np.max(upper - lower))
    assert np.allclose(contained.max(axis=0), upper, atol=0.06 * np.max(upper - lower))
    fraction = inside.mean()
    error = np.prod(upper - lower + 2 * margin) * np.sqrt(fraction * (1 - fraction) / len(points))
    measured = fraction * np.prod(upper - lower + 2 * margin)
    assert body.volume() == pytest.approx(measured, abs=4 * error)
    if name in EXACT:
        assert body.volume() == pytest.approx(EXACT[name], rel=2e-4)


def test_nodes_on_faces_of_a_box_are_inside_in_spite_of_rounding() -> None:
    box = shape({"box": {"corner": [0.0, 0.0], "size": [0.3, 1.0]}})
    assert box.inside(np.array([[0.1 + 0.2, 0.5]])).all()
    assert not box.inside(np.array([[0.3 + 1e-8, 0.5]])).any()


LEVEL: dict[str, tuple[int, dict[str, Any]]] = {
    "half_space": (2, {"half_space": {"point": [0.3, 0.3], "normal": [0, 1]}}),
    "turned half_space": (2, {"transformed": {"shape": {"half_space": {"point": [0.3, 0], "normal": [1, 0]}},
                                              "angle": 90}}),
    "terrain": (2, {"height_field": {"points": [[0, 0.3], [2, 0.3]]}}),
    "bottom": (2, {"height_field": {"points": [[0, 1], [2, 1]], "bottom": 0.1 + 0.2}}),
    "span": (3, {"height_field": {"points": [[0, 1], [2, 1]], "span": [0.9000000000000001, 2], "up": "z"}}),
    "cylinder": (3, {"cylinder": {"start": [0.9, 0, 0], "end": [0.9, 0, 0.3], "radius": 1}}),
    "side of a cylinder": (3, {"cylinder": {"start": [0, 0, 0], "end": [2, 0, 0], "radius": 0.3}}),
    "cone": (3, {"cone": {"start": [0.9, 0, 0], "end": [0.9, 0, 0.3], "start_radius": 0.5, "end_radius": 1}}),
    "side of a cone": (2, {"cone": {"start": [0, 0], "end": [2, 0], "start_radius": 0.4,
                                    "end_radius": 0.4 - 0.1 / 0.45}}),
    "capsule": (2, {"capsule": {"start": [0, 0], "end": [2, 0], "radius": 0.3}}),
    "head of a capsule": (2, {"capsule": {"start": [0.9, -2], "end": [0.9, 0.1], "radius": 0.7, "end_radius": 0.2}}),
    "ball": (2, {"ball": {"center": [0.9, 0], "radius": 0.3}}),
}  # fmt: skip


@pytest.mark.parametrize("name", LEVEL)
def test_nodes_on_a_face_are_inside_in_spite_of_rounding(name: str) -> None:
    """Nodes on a floor at 0.3 m may be some bits above it; if they were outside, the floor would be a cell too low."""
    dim, data = LEVEL[name]
    ulps = np.arange(-3, 4) * np.spacing(0.3)
    on_it = np.zeros((7, dim))
    on_it[:, 0], on_it[:, -1] = 0.9 + ulps, 0.3 + ulps
    assert shape(data).inside(on_it).all()
    up = 1e-7 * (-1.0 if name == "bottom" else 1.0)
    off_it = np.array([[0.9 - 1e-7 * (name == "span"), *[0.0] * (dim - 2), 0.3 + up]])
    assert not shape(data).inside(off_it).any()


@pytest.mark.parametrize("size", [1e-4, 1.0, 1e4])
def test_tolerance_of_a_face_scales_with_the_unit_of_length(size: float) -> None:
    ground = shape({"half_space": {"point": [0, 0.15 * size], "normal": [0, 1]}})
    heights = np.array([6 * (0.025 * size), 0.15 * size * (1 + 1e-8)])
    assert ground.inside(np.stack([[0.0, 0.0], heights], axis=1)).tolist() == [True, False]


def test_half_space_lies_behind_its_plane() -> None:
    ground = shape({"half_space": {"point": [0, 1], "normal": [0, 3]}})
    assert ground.inside(np.array([[9, 0.5], [9, 1.5]])).tolist() == [True, False]
    assert [side.tolist() for side in ground.bounds()] == [[-np.inf, -np.inf], [np.inf, 1.0]]
    slope = shape({"half_space": {"point": [0, 1], "normal": [1, 1]}})
    assert np.isinf(slope.bounds()).all()


def test_edges_and_corners_of_a_polygon_are_inside() -> None:
    corners = np.array([[0.1, 0.1], [0.4, 0.1], [0.4, 0.1], [0.6, 0.3], [0.3, 0.7]])  # one of them given twice
    body = shape({"polygon": {"points": corners.tolist()}})
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    assert body.inside(np.concatenate([corners, middles])).all()
    outward = middles - corners.mean(axis=0)
    assert not body.inside(middles + 1e-7 * outward).any()


def test_polygon_crossing_itself_follows_the_even_odd_rule() -> None:
    bow = shape({"polygon": {"points": [[0, 0], [2, 2], [2, 0], [0, 2]]}})
    points = np.array([[0.25, 1.0], [1.75, 1.0], [1.0, 0.5], [1.0, 1.5]])
    assert bow.inside(points).tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"box": {"corner": [0, 0], "size": [1, 0]}}, "must be greater than 0, is 0"),
        ({"ball": {"center": [0, 0], "radius": -1}}, "must be greater than 0, is -1"),
        ({"capsule": {"start": [0, 0], "end": [0, 0], "radius": 1}}, "must differ from start"),
        ({"capsule": {"start": [0, 0], "end": [0, 0, 1], "radius": 1}}, "as many entries as start"),
        ({"half_space": {"point": [0, 0], "normal": [0, 0]}}, "must not be zero"),
        ({"polygon": {"points": [[0, 0], [1, 1]]}}, "must have at least 3 entries, has 2"),
        ({"difference": [{"ball": {"center": [0, 0], "radius": 1}}]}, "must have at least 2 entries, has 1"),
        ({"bal": {}}, "did you mean 'ball'?"),
        ({}, "must name exactly one of ball, box, capsule"),
        ("ball", "must be a mapping `name: {...}`, is 'ball': write `{ball: {...}}`"),
        ("bal", "is 'bal' (did you mean 'ball'?)"),
    ],
)
def test_invalid_shape_is_an_error(data: Any, message: str) -> None:
    with pytest.raises(ValidationError) as info:
        shape(data)
    assert message in info.value.errors()[0]["msg"]


def test_dimension_errors_name_the_field() -> None:
    box = shape({"box": {"corner": [0, 0], "size": [1, 1, 1]}})
    assert box.dim_problems(3) == [(("corner",), "must have 3 entries in this 3D world, has 2")]
    assert box.dim_problems(2)[0][0] == ("size",)
    assert "needs a 3D world" in shape(CASES["cylinder"][1]).dim_problems(2)[0][1]
    assert shape(CASES["cylinder"][1]).dim_problems(3) == []
    assert "needs a 2D world" in shape(CASES["polygon"][1]).dim_problems(3)[0][1]
    assert shape(CASES["polygon"][1]).dim_problems(2) == []


WITHOUT_A_DISTANCE = ("hills", "valley", "difference", "intersection", "sweep", "chain")


@pytest.mark.parametrize("name", CASES)
def test_solids_hold_the_same_points(name, rng):
    """The signed distance of the nearest solid is negative inside, or it is not known."""
    dim, data = CASES[name]
    one = shape(data)
    if name in WITHOUT_A_DISTANCE:
        with pytest.raises(UsageError, match="distance"):
            one.solids()
        return
    lower, upper = one.bounds()
    points = rng.uniform(lower - 0.1, upper + 0.1, (1000, dim))
    assert (distance(one, points) <= 0).tolist() == one.inside(points).tolist()


@pytest.mark.parametrize("data", [
    {"half_space": {"point": [0.1, 0.2], "normal": [3, 4]}},
    {"height_field": {"sinusoid": HILLS}},
    {"height_field": {"points": [[0, 1], [1, 2], [3, 0.5]]}},
])  # fmt: skip
def test_solids_without_bounds_hold_the_same_points(data, rng):
    points = rng.uniform(-1, 4, (1000, 2))
    assert (distance(shape(data), points) <= 0).tolist() == shape(data).inside(points).tolist()


def distance(one: Shape, points: np.ndarray) -> np.ndarray:
    """Return the distance to the surface of the nearest solid, negative inside."""
    table = make_solids(one.solids())
    places = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    each = [[signed_distance(table, k, tuple(x))[0] for k in range(len(table.kind))] for x in places]
    return np.min(each, axis=1)


def test_a_capsule_of_which_one_end_lies_inside_the_other_is_an_error() -> None:
    message = "is 1.2, and the radius 0.1: they must differ by less than the length of 1, or one end lies inside"
    with pytest.raises(ValidationError, match=message):
        shape({"capsule": {"start": [0, 0], "end": [1, 0], "radius": 0.1, "end_radius": 1.2}})
    assert "end_radius" not in shape({"capsule": {"start": [0, 0], "end": [1, 0], "radius": 0.1}}).model_dump()
