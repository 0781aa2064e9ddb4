"""What the reference frame cannot do is refused by name before a run, with the other frame as the way out."""

from __future__ import annotations

from typing import Any

import pytest

from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.scene.load import load_scene

MATERIAL = {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 1e4, "poissons_ratio": 0.3}}}
BODY = {"shape": {"box": {"corner": [0.2, 0.4], "size": [0.4, 0.1]}}, "particles_per_cell": 4, "material": MATERIAL}
CLAMP = {"sticky": {"region": {"box": {"corner": [0.1, 0.3], "size": [0.12, 0.3]}}}}


def scene(**changes: Any) -> dict[str, Any]:
    """Return a clamped beam in the reference frame."""
    return {
        "cqrun": 1,
        "world": {"size": [1, 1], "dx": 0.02, "frame": "reference"},
        "bodies": {"a": BODY},
        "boundaries": {"clamp": CLAMP},
        "time": {"duration": 0.1, "control_step": 0.1},
        **changes,
    }


def test_a_clamped_body_is_accepted():
    built = build(load_scene(scene()))
    assert built.model.frame == "reference"
    assert built.model.n_nodes == 23 * 8
    assert built.model.state_bytes == built.model.n_nodes * 8 * 8


SLAB = {"box": {"corner": [0, 0], "size": [1, 0.1]}}
HOLE = {"ball": {"center": [0.5, 0.1], "radius": 0.05}}
FLOOR = {"face": "y_min", "thickness": 0.06}
MOVES = {"sticky": CLAMP["sticky"] | {"displacement": [0.01, 0]}}
WORLD = {"size": [1, 1], "dx": 0.02, "frame": "updated"}
ELSEWHERE = {
    "a clamp that moves": (
        {"boundaries": {"clamp": MOVES}},
        "boundaries.clamp.sticky: moves in the reference frame alone",
    ),
    "a start at rest": ({"start": "equilibrium"}, "start: is found in the reference frame alone"),
}


@pytest.mark.parametrize("name", ELSEWHERE)
def test_what_the_other_frame_cannot_do_is_refused(name):
    changes, message = ELSEWHERE[name]
    build(load_scene(scene(**changes)))
    with pytest.raises(SceneError, match=r"set `world\.frame: reference`") as raised:
        build(load_scene(scene(**changes, world=WORLD)))
    assert message in str(raised.value)


UNCLEAR = {
    "rotation": ({"rotation": [0.1, 0, 0]}, "must have 1 entries in this 2D world, has 3"),
    "center": ({"displacement": [0.1, 0], "center": [0, 0, 0]}, "must have 2 entries in this 2D world, has 3"),
    "over": ({"over": 1.0}, "has no effect without `displacement or rotation`"),
}


@pytest.mark.parametrize("name", UNCLEAR)
def test_a_clamp_says_which_of_its_fields_do_not_fit(name):
    fields, message = UNCLEAR[name]
    with pytest.raises(SceneError) as raised:
        load_scene(scene(boundaries={"clamp": {"sticky": CLAMP["sticky"] | fields}}))
    assert message in str(raised.value)


def test_a_body_that_starts_at_rest_has_no_velocity():
    with pytest.raises(SceneError, match=r"bodies\.a\.velocity: has no effect with `start: equilibrium`"):
        build(load_scene(scene(start="equilibrium", bodies={"a": BODY | {"velocity": [1, 0]}})))


REFUSED = {
    "a floor whose distance is not known": (
        {"boundaries": {"floor": {"separate": {"region": {"difference": [SLAB, HOLE]}, "normal": [0, 1]}}}},
        "boundaries.floor.separate.region: the distance from the surface of 'difference' is not known",
    ),
    "a floor that slips, which the body would fall on": (
        {"boundaries": {"clamp": CLAMP, "floor": {"slip": FLOOR}}}, "boundaries.floor.slip: holds no particle at rest",
    ),
    "one particle in a cell": (
        {"bodies": {"a": BODY | {"particles_per_cell": 1}}},
        "bodies.a.particles_per_cell: has 1 particles in a cell, too few for the reference frame",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_it_cannot_do_is_refused(name):
    changes, message = REFUSED[name]
    with pytest.raises(SceneError) as raised:
        build(load_scene(scene(**changes)))
    assert message in str(raised.value)
    assert "world.frame: updated" in str(raised.value)


def test_a_clamp_that_misses_its_body_says_by_how_much():
    away = {"sticky": {"region": {"box": {"corner": [0, 0.3], "size": [0.12, 0.3]}}}}
    with pytest.raises(SceneError, match=r"the nearest particle is of 'a', 0.0851 m \(4.3 cells\) away"):
        build(load_scene(scene(boundaries={"clamp": away})))


SIZE = "bodies.a.shape.box.size.0"


def test_a_shape_as_unknown_reaches_the_rest_positions():
    built = build(load_scene(scene(unknowns={SIZE: {"bounds": [0.3, 0.4]}})))
    assert built.assembly.inputs({SIZE: 0.35}).shaped
    assert not built.assembly.inputs({"world.gravity.1": -9.0}).shaped


def test_a_shape_that_grows_keeps_two_particles_in_a_cell():
    """With fewer, nodes could move in ways that no particle feels."""
    with pytest.raises(
        SceneError, match=r"fewer than two in a cell of 0\.02 m, so nodes would move without resistance"
    ):
        build(load_scene(scene(unknowns={SIZE: {"bounds": [0.3, 0.5]}})))
