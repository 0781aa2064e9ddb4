"""Named regions of loads, groups and boundaries: what a name means in each place, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.build.model import build
from cqrun.build.particles import sample
from cqrun.engine.setting import grid_shape, node_positions
from cqrun.errors import SceneError
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.schema import Scene

MATERIAL = {"density": 2.0, "elastic": {"neo_hookean": {"youngs_modulus": 10.0, "poissons_ratio": 0.3}}}
LEFT = {"half_space": {"point": [0.3, 0], "normal": [1, 0]}}
LOW = {"half_space": {"point": [0, 0.3], "normal": [0, 1]}}
PARTS = {
    "leg": {"box": {"corner": [0.1, 0.1], "size": [0.2, 0.2]}},
    "arm": {"box": {"corner": [0.1, 0.3], "size": [0.4, 0.2]}},
}


def scene(**more: Any) -> Scene:
    """Return a scene with a body of a leg (16 particles) and an arm (32); `more` replaces its sections."""
    data = {
        "cqrun": 1,
        "world": {"size": [1.0, 1.0], "dx": 0.1, "frame": "updated"},
        "bodies": {"b": {"parts": PARTS, "spacing": 0.05, "material": MATERIAL}},
        "time": {"duration": 0.1, "control_step": 0.1},
        **more,
    }
    return load_scene(data)


@pytest.mark.parametrize("kind", ["separate", "slip"])
def test_a_named_half_space_has_its_normal(kind):
    """It gives the same boundary as a region without a name."""
    inline = build(scene(boundaries={"low": {kind: {"region": LOW}}})).model.conditions
    for regions in ({"ground": LOW}, {"ground": "below", "below": LOW}):
        named = build(scene(regions=regions, boundaries={"low": {kind: {"region": "ground"}}})).model.conditions
        assert [c.normal for c in named] == [c.normal for c in inline] == [(0.0, 1.0)]
        np.testing.assert_array_equal(named[0].nodes, inline[0].nodes)
    box = {"box": {"corner": [0.1, 0.1], "size": [0.2, 0.2]}}
    with pytest.raises(SceneError, match=f"boundaries.low.{kind}: a region other than half_space and height_field"):
        build(scene(regions={"ground": box}, boundaries={"low": {kind: {"region": "ground"}}}))


def body(**more: Any) -> dict[str, Any]:
    return {"bodies": {"b": {"parts": PARTS, "spacing": 0.05, "material": MATERIAL, **more}}}


def error_of(**more: Any) -> str:
    with pytest.raises(SceneError) as info:
        sample(scene(**more))
    return str(info.value)


def mass(region: Any) -> dict[str, Any]:
    return {"extra": {"attached_mass": {"body": "b", "mass": 1.0, "region": region}}}


@pytest.mark.parametrize(
    ("region", "count"),
    [
        ("leg", 16),
        ("left", 32),
        ("low_left", 16),
        ({"difference": ["left", "leg"]}, 16),
        ({"union": ["leg", LEFT]}, 32),
        ({"cluster": {"count": 2, "index": 0}}, None),
        (LEFT, 32),
    ],
)
def test_a_load_takes_a_name_a_shape_or_a_combination(region: Any, count: int | None) -> None:
    regions = {"left": LEFT, "low_left": {"intersection": ["left", "leg"]}}
    loaded = scene(regions=regions, loads=mass(region))
    particles = sample(loaded)
    inside = particles.inside("b", loaded.loads["extra"].value.region)  # type: ignore[attr-defined]
    assert 0 < len(inside) < 48
    assert count is None or len(inside) == count
    # the resolved scene has the same region
    again = load_scene(dump(resolve(loaded)))
    assert resolve(again) == resolve(loaded)
    assert np.array_equal(sample(again).inside("b", again.loads["extra"].value.region), inside)  # type: ignore[attr-defined]


def test_a_name_alone_picks_particles_too() -> None:
    particles = sample(scene(regions={"left": LEFT}))
    assert np.array_equal(particles.inside("b", "leg"), particles.groups("b")["leg"])
    assert len(particles.inside(None, "left")) == 32
    assert len(particles.inside("b", None)) == len(particles.inside(None, None)) == 48


def test_groups_combine_parts_and_groups_in_the_coordinates_of_the_body() -> None:
    below = {"half_space": {"point": [0, 0.2], "normal": [0, 1]}}
    groups = {"lower": below, "foot": {"intersection": ["lower", "leg"]}}
    particles = sample(scene(**body(groups=groups, place={"offset": [0.2, 0.3], "angle": 10}), regions={"left": LEFT}))
    assert {name: len(indices) for name, indices in particles.groups("b").items()} == {
        "leg": 16, "arm": 32, "lower": 8, "foot": 8,
    }  # fmt: skip


def test_a_region_of_the_scene_is_in_world_coordinates() -> None:
    moved = sample(scene(**body(place={"offset": [0.2, 0.0]}), regions={"left": LEFT}))
    assert len(moved.inside("b", "left")) == 0


def test_a_group_name_selects_the_group_of_each_body() -> None:
    data = body()["bodies"]
    data["c"] = {**data["b"], "place": {"offset": [0.5, 0.0]}}
    loaded = scene(bodies=data, loads={"w": {"attached_mass": {"mass": 1.0, "region": "leg"}}})
    particles = sample(loaded)
    assert len(particles.inside(None, "leg")) == 32
    assert len(particles.inside("c", "leg")) == 16


def test_a_boundary_takes_a_named_shape_and_holds_the_same_nodes() -> None:
    box = {"box": {"corner": [0, 0], "size": [1, 0.2]}}
    west = {"half_space": {"point": [0.25, 0], "normal": [1, 0]}}
    regions = {"base": box, "corner": {"intersection": ["base", west]}}
    by_name = build(scene(regions=regions, boundaries={"clamp": {"sticky": {"region": "base"}}}))
    by_shape = build(scene(boundaries={"clamp": {"sticky": {"region": box}}}))
    assert (by_name.model.conditions[0].nodes == by_shape.model.conditions[0].nodes).all()
    corner = build(scene(regions=regions, boundaries={"wall": {"slip": {"region": "corner", "normal": [0, 1]}}}))
    nodes = node_positions(grid_shape(np.ones(2), 0.1), 0.1)[corner.model.conditions[0].nodes]
    assert len(nodes) == 3 * 3
    assert nodes.max(axis=0) == pytest.approx([0.2, 0.2])


def test_terrain_is_a_boundary_or_a_body() -> None:
    hills = {"sinusoid": {"amplitude": 0.02, "wavelength": 0.5, "base": 0.05}}
    named = {"ground": {"height_field": hills}}
    ground = build(scene(regions=named, boundaries={"g": {"sticky": {"region": "ground"}}}))
    nodes = node_positions(grid_shape(np.ones(2), 0.1), 0.1)[ground.model.conditions[0].nodes]
    assert nodes[:, 1].max() == 0.0
    land = {"shape": {"height_field": {**hills, "span": [0.0, 1.0], "bottom": 0.0}}, "particles_per_cell": 9}
    terrain = scene(bodies={**body()["bodies"], "terrain": {**land, "material": MATERIAL}})
    particles = sample(terrain)
    assert particles.volume[particles.of("terrain")].sum() == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            {"loads": mass("lg")},
            "scene: loads.extra.attached_mass.region: there is no region 'lg' (did you mean 'leg'?); there are: leg,",
        ),
        (
            {"regions": {"a": {"union": [LEFT, "legs"]}}},
            "scene: regions.a.union.shapes.1: there is no region 'legs' (did you mean 'leg'?); there are: a, leg, arm",
        ),
        (body(groups={"a": "lef"}) | {"regions": {"left": LEFT}}, "bodies.b.groups.a: there is no region 'lef'"),
        ({"regions": {"leg": LEFT}}, "scene: regions.leg: is also a group of the body 'b': rename one"),
        (body(groups={"leg": LEFT}), "scene: bodies.b.groups.leg: is also a part or a colour of the body 'b'"),
        ({"regions": {"a": "a"}}, "scene: regions.a: is made of itself: a region can only be made of others"),
        ({"regions": {"a": {"union": ["b", LEFT]}, "b": "a"}}, "regions.a: is made of itself, through 'b'"),
        (body(groups={"a": {"union": ["c"]}, "c": "a"}), "bodies.b.groups.c: is made of itself, through 'a'"),
        (
            {"boundaries": {"w": {"sticky": {"region": "leg"}}}},
            "scene: boundaries.w.sticky.region: there is no region 'leg'; there are: none",
        ),
        (
            {"regions": {"a": {"union": ["leg", LEFT]}}, "boundaries": {"w": {"sticky": {"region": "a"}}}},
            "boundaries.w.sticky.region: must select grid nodes, but 'leg' is a group of particles",
        ),
        (
            {
                "regions": {"a": {"cluster": {"count": 2, "index": 0}}},
                "boundaries": {"w": {"sticky": {"region": "a"}}},
            },
            "boundaries.w.sticky.region: must select grid nodes, but 'cluster' selects particles: give a shape",
        ),
        (
            {"regions": {"a": {"cluster": {"count": 2, "index": 0, "body": "c"}}}},
            "regions.a.cluster.body: there is no body 'c'",
        ),
        (
            {"loads": mass({"cluster": {"count": 49, "index": 0}})},
            "scene: loads.extra.attached_mass.region: 49 clusters of 48 particles",
        ),
        ({"loads": mass({"difference": ["leg", LEFT]})}, "loads.extra.attached_mass.region: holds no particle"),
        (
            {"loads": mass({"nearest_marker": {"markers": {"a": [0, 0], "b": [1]}, "marker": "a"}})},
            "nearest_marker.markers.b: must have 2 entries in this 2D world, has 1",
        ),
    ],
)
def test_invalid_regions_are_refused_with_their_place(more: dict[str, Any], message: str) -> None:
    assert message in error_of(**more)
