"""What the grid cannot resolve is a warning before a run, with the size that it needs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.build.check_grid import thinner
from cqrun.build.model import build
from cqrun.scene.load import load_scene

MATERIAL = {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 1e4, "poissons_ratio": 0.3}}}
DX = 0.02
BODY = {"shape": {"ball": {"center": [0.5, 0.7], "radius": 0.1}}, "particles_per_cell": 4, "material": MATERIAL}


def box(corner: list[float], size: list[float]) -> dict[str, Any]:
    return {"box": {"corner": corner, "size": size}}


def warnings(
    boundaries: dict[str, Any] | None = None,
    gravity: tuple[float, float] = (0.0, 0.0),
    frame: str = "updated",
    **body: Any,
) -> list[str]:
    """Return the warnings on a world of 50 by 50 cells with one body."""
    scene = {
        "cqrun": 1,
        "world": {"size": [1, 1], "dx": DX, "frame": frame, "gravity": list(gravity)},
        "bodies": {"a": {**BODY, **body}},
        "boundaries": boundaries or {},
        "time": {"duration": 0.1, "control_step": 0.1},
    }
    return [str(warning) for warning in build(load_scene(scene)).warnings]


def shelf(kind: str, corner: list[float], size: list[float]) -> dict[str, Any]:
    fields = {"separate": {"normal": [0, 1]}, "sticky": {}}[kind]
    return {"shelf": {kind: {"region": box(corner, size), **fields}}}


@pytest.mark.parametrize(("thickness", "leaks"), [(0.001, True), (0.019, True), (0.021, False), (0.1, False)])
def test_a_shelf_of_a_single_row_of_nodes_leaks(thickness, leaks):
    message = (
        "scene: boundaries.shelf.separate.region: is a single row of nodes at (0.3, 0.4) m, which bodies pass through: "
        "make it 0.04 m thick, or 0.02 m with its faces on nodes"
    )
    assert warnings(shelf("separate", [0.3, 0.4], [0.4, thickness])) == [message] * leaks


@pytest.mark.parametrize(
    "region",
    [
        box([0.3, 0.0], [0.4, 0.001]),  # nothing comes from below the world
        box([0.0, 0.0], [0.02, 1.0]),
        {"ball": {"center": [0.5, 0.3], "radius": 0.1}},  # thin at its poles alone
        {"polygon": {"points": [[0.2, 0.1], [0.5, 0.4], [0.8, 0.1]]}},
        {"half_space": {"point": [0, 0.3], "normal": [0.5, 0.75**0.5]}},
    ],
)
def test_regions_that_hold(region):
    assert warnings({"rock": {"separate": {"region": region, "normal": [0, 1]}}} if "half" not in str(region) else
                    {"rock": {"separate": {"region": region}}}) == []  # fmt: skip


def test_a_post_on_a_floor_is_thin():
    floor = {"union": {"shapes": [box([0, 0], [1, 0.1]), box([0.3, 0], [0.001, 0.4])]}}
    (told,) = warnings({"floor": {"separate": {"region": floor, "normal": [0, 1]}}})
    assert "is a single row of nodes at (0.3, 0.14) m" in told


@pytest.mark.parametrize(("height", "told"), [(0.016, True), (0.03, True), (0.06, False)])
def test_a_neck_between_two_blocks(height, told):
    """A flexure hinge is a small part of its body."""
    blocks = {"left": box([0.1, 0.5], [0.3, 0.2]), "right": box([0.46, 0.5], [0.3, 0.2])}
    neck = {"neck": box([0.4, 0.6], [0.06, height])}
    found = [each for each in warnings(shape=None, parts=blocks | neck) if "neck less than 2 cells thick" in each]
    assert len(found) == told
    assert all("which joins thicker parts" in each and "make it 0.06 m thick" in each for each in found)


@pytest.mark.parametrize(("height", "cells"), [(1, "1"), (2, "2"), (3, None), (6, None)])
@pytest.mark.parametrize("place", [None, {"angle": 30, "offset": [0.5, 0.2]}, {"scale": 2, "offset": [0.1, 0.2]}])
def test_a_body_that_is_thin(height, cells, place):
    scale = (place or {}).get("scale", 1)
    shape = box([0.1, 0.1], [0.4 / scale, height * DX / scale])
    told = warnings(shape=shape, place=place)
    if cells is None:
        assert told == []
        return
    (message,) = told
    assert message.startswith(f"scene: bodies.a.shape: is {cells} cell{'s' * (height > 1)} thick at (")
    assert f"set dx to {height * DX / 3:.3g} m, or make it 0.06 m thick" in message


def test_a_thin_part_of_a_body():
    parts = {"trunk": box([0.3, 0.4], [0.3, 0.1]), "leg": box([0.3, 0.2], [0.02, 0.2])}
    (told,) = warnings(shape=None, parts=parts)
    assert told.startswith("scene: bodies.a.parts: is 1 cell thick at (0.30")
    short = {"trunk": parts["trunk"], "foot": box([0.3, 0.36], [0.02, 0.04])}
    assert warnings(shape=None, parts=short) == []


@pytest.mark.parametrize(
    ("frame", "sampling", "gap", "told", "free"),
    [
        ("updated", "lattice", 0.5, "1.5 cells wide: the material", 0.03), ("updated", "lattice", 1, "1.5 cells", 0.03),
        ("updated", "lattice", 1.5, "", 0), ("reference", "lattice", 0.5, "0.875 cells wide: no layer", 0.0175),
        ("reference", "lattice", 1, "", 0), ("reference", "jittered", 1, "1.5 cells wide: the material", 0.06),
        ("reference", "jittered", 2, "3 cells wide: both sides share nodes", 0.06), ("reference", "jittered", 3, "", 0),
    ],
)  # fmt: skip
def test_a_gap_within_a_body(frame, sampling, gap, told, free):
    """Two fingers on one hand."""
    width = gap * DX
    fingers = [box([0.3, 0.3], [0.1, 0.3]), box([0.4 + width, 0.3], [0.1, 0.3]), box([0.3, 0.2], [0.2 + width, 0.1])]
    found = warnings(shape={"union": {"shapes": fingers}}, frame=frame, sampling={sampling: {}})
    assert ["has a gap or a hole at (0.4" in text and told in text for text in found] == [True] * bool(told)
    assert all(f"make it {free} m wide" in text for text in found)


def test_a_hole_that_closes():
    hole = {"ball": {"center": [0.5, 0.5], "radius": 0.012}}
    assert not warnings(shape={"difference": [box([0.4, 0.4], [0.2, 0.2]), hole]})  # smaller than a cell and a half
    slot = box([0.42, 0.5], [0.16, 0.02])
    (told,) = warnings(shape={"difference": [box([0.4, 0.4], [0.2, 0.2]), slot]})
    assert "has a gap or a hole at (0.4" in told


@pytest.mark.parametrize(("wall", "told"), [(1.0, True), (1.5, True), (2.25, False), (3, False)])
def test_a_thin_wall_of_a_cavity(wall, told):
    """It is a small part of a thick body, in which two cavities are 6 cells apart."""
    block, width = box([0.2, 0.2], [0.6, 0.6]), wall * DX
    holes = [box([0.3, 0.8 - width - 0.08], [0.16, 0.08]), box([0.58, 0.4], [0.1, 0.1])]
    found = warnings(shape={"difference": [block, *holes]})
    assert ["has a wall less than 2 cells thick at (0.3" in text for text in found] == [True] * told
    assert all("make it 0.06 m thick" in text for text in found)
    beside = [box([0.3, 0.4], [0.16, 0.08]), box([0.46 + width, 0.4], [0.1, 0.1])]
    found = warnings(shape={"difference": [block, *beside]})
    assert ["has a wall less than 2 cells thick at (0.4" in text for text in found] == [True] * told


def test_the_walls_of_a_hollow_body_are_as_thick_as_they_are():
    """Where walls meet they are deeper, and their corners do not count."""
    for cells in (1, 2):
        rooms = [box([0.2 + cells * DX + k * (0.16 + cells * DX), 0.3 + cells * DX], [0.16, 0.2]) for k in range(3)]
        outer = box([0.2, 0.3], [3 * 0.16 + 4 * cells * DX, 0.2 + 2 * cells * DX])
        (message,) = warnings(shape={"difference": [outer, *rooms]})
        assert f"is {cells} cell{'s' * (cells > 1)} thick at (0.2" in message
        assert f"set dx to {cells * DX / 3:.3g} m" in message


def test_a_clamp_that_misses_its_body():
    (message,) = warnings(shelf("sticky", [0.3, 0.2], [0.4, 0.39]))
    assert message == (
        "scene: boundaries.shelf.sticky.region: holds 420 nodes but no particle: the nearest particle is of 'a', "
        "0.0255 m (1.3 cells) away; to clamp a body, let the region reach into it"
    )


@pytest.mark.parametrize("top", [0.65, 0.4])
def test_a_clamp_that_holds_its_body_and_ground_far_below_it(top):
    assert warnings(shelf("sticky", [0.3, 0.2], [0.4, top - 0.2]), gravity=(0, -9.81)) == []


AWAY = "no particle: the nearest particle is of 'a', 0.205 m (10 cells) away; to clamp a body"


@pytest.mark.parametrize(
    ("gravity", "velocity", "meets"),
    [((0, 0), (0, 0), False), ((0, -9.81), (0, 0), True), ((9.81, 0), (0, 0), False), ((0, 9.81), (0, 0), False),
     ((0, 0), (0.1, -1), True), ((0, 0), (1, 0.1), False)],
)  # fmt: skip
def test_a_clamp_far_from_a_body_that_does_not_come_to_it(gravity, velocity, meets):
    """The shelf is 0.2 m below the ball."""
    told = warnings(shelf("sticky", [0.3, 0.2], [0.4, 0.2]), gravity=gravity, velocity=list(velocity))
    assert [AWAY in text for text in told] == [True] * (not meets)


def test_an_obstacle_far_from_a_body_that_is_clamped():
    clamp = {"clamp": {"sticky": {"region": box([0.3, 0.75], [0.4, 0.1])}}}
    assert warnings(shelf("sticky", [0.3, 0.2], [0.4, 0.2]) | clamp) == []


@pytest.mark.parametrize(("top", "inside"), [(0.6, False), (0.61, False), (0.62, True), (0.66, True)])
def test_a_body_that_starts_inside_a_boundary(top, inside):
    """The ball reaches down to y = 0.6 m."""
    told = warnings(shelf("separate", [0.3, 0.2], [0.4, top - 0.2]))
    if not inside:
        assert told == []
        return
    (message,) = told
    assert message.startswith("scene: boundaries.shelf.separate: ")
    assert "particles start inside it, such as one of 'a' at (0.4" in message
    floor = {"floor": {"friction": {"face": "y_min", "thickness": top, "coefficient": 0.5}}}
    assert [text.partition(" particles")[2] for text in warnings(floor)] == [message.partition(" particles")[2]]


def test_the_thickness_of_a_slab_is_exact():
    """In the middle of a raster and at its edge, in 2D and 3D."""
    for dim in (2, 3):
        for cells in range(1, 12):
            solid = np.zeros((20,) * dim, bool)
            solid[3 : 3 + cells] = True
            assert thinner(solid, 6).any() == (cells < 5)
