"""Bodies: their place, parts that are filled separately, and the particles of CQ1's robots."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cqrun.build.assembly import Assembly
from cqrun.build.particles import Particles, sample
from cqrun.errors import SceneError
from cqrun.scene.load import load_scene
from cqrun.scene.schema import Scene

BIPED = {
    name: {"box": {"corner": corner, "size": [1.0 if name.startswith("b") else 0.5, 1.0]}}
    for name, corner in {
        "l0": [0.0, 0.0], "l1": [0.5, 0.0], "b0": [0.0, 1.0], "b1": [1.0, 1.0], "b2": [2.0, 1.0],
        "l2": [2.0, 0.0], "l3": [2.5, 0.0],
    }.items()
}  # fmt: skip
"""CQ1's 2D walker: seven boxes, in its own units."""
E_PATH = "bodies.b.material.elastic.neo_hookean.youngs_modulus"


def scene(body: dict[str, Any], *overrides: str, **more: Any) -> Scene:
    """Return a scene with one body `b`; its particles are 0.05 m apart unless the body gives a count."""
    material = {"density": 2.0, "elastic": {"neo_hookean": {"youngs_modulus": 10.0, "poissons_ratio": 0.3}}}
    spacing = {} if "sampling" in body else {"spacing": 0.05}
    data = {
        "cqrun": 1,
        "world": {"size": [1.0, 1.0], "dx": 0.1, "frame": "updated"},
        "bodies": {"b": {"material": material, **spacing, **body}},
        "time": {"duration": 0.1, "control_step": 0.1},
        **more,
    }
    return load_scene(data, overrides)


def particles(body: dict[str, Any], *overrides: str, **more: Any) -> Particles:
    return sample(scene(body, *overrides, **more))


def box(corner: list[float], size: list[float]) -> dict[str, Any]:
    return {"box": {"corner": corner, "size": size}}


def error_of(body: dict[str, Any], *overrides: str, **more: Any) -> str:
    with pytest.raises(SceneError) as info:
        particles(body, *overrides, **more)
    return str(info.value)


def test_a_placed_body_is_moved_together_with_its_groups() -> None:
    local = {"shape": box([0, 0], [2, 1]), "groups": {"right": {"half_space": {"point": [1, 0], "normal": [-1, 0]}}}}
    placed = particles({**local, "place": {"scale": 0.2, "offset": [0.3, 0.1], "angle": 90}})
    assert placed.x.min(axis=0) == pytest.approx([0.125, 0.125])
    assert placed.x.max(axis=0) == pytest.approx([0.275, 0.475])
    assert placed.volume == pytest.approx(np.full(32, 0.05**2))
    # the local right end is the upper one in the world
    right = placed.groups("b")["right"]
    assert len(right) == 16
    assert (placed.x[right, 1] > 0.3).all()


def test_a_lattice_turns_with_its_body() -> None:
    body = {"shape": box([0, 0], [0.4, 0.2]), "place": {"angle": 20, "offset": [0.3, 0.3]}}
    turned = particles(body)
    assert len(turned.x) == 32
    nearest = np.sort(np.linalg.norm(turned.x[:, None] - turned.x, axis=2), axis=1)[:, 1]
    assert nearest == pytest.approx(np.full(32, 0.05))


def test_the_bounds_of_the_world_are_checked_for_the_placed_body() -> None:
    body = {"shape": box([0, 0], [0.4, 0.2]), "place": {"offset": [0.9, 0.3]}}
    assert error_of(body).startswith("scene: bodies.b.place: reaches x = 1.275 m, above 1 m")


def test_every_part_of_the_biped_has_the_same_number_of_particles() -> None:
    body = {
        "parts": BIPED, "place": {"scale": 0.2, "offset": [0.2, 0.1]}, "sampling": {"lattice": {"count": 20}},
        "unit_mass": True,
    }  # fmt: skip
    sampled = particles(body)
    assert len(sampled.x) == 7 * 20**2 == 2800
    groups = sampled.groups("b")
    assert list(groups) == list(BIPED)
    assert all(len(indices) == 400 for indices in groups.values())
    assert np.array_equal(np.sort(np.concatenate(list(groups.values()))), np.arange(2800))
    assert (sampled.volume == 1).all()
    for name, shape in BIPED.items():
        low = 0.2 * np.array(shape["box"]["corner"]) + [0.2, 0.1]
        size = 0.2 * np.array(shape["box"]["size"])
        x = sampled.x[groups[name]]
        assert x.min(axis=0) == pytest.approx(low + size / 40)
        assert x.max(axis=0) == pytest.approx(low + size - size / 40)


def test_cells_of_a_count_share_the_volume_of_their_part() -> None:
    parts = {"small": box([0.1, 0.1], [0.1, 0.2]), "large": box([0.2, 0.1], [0.4, 0.2])}
    sampled = particles({"parts": parts, "sampling": {"lattice": {"count": 10}}})
    groups = sampled.groups("b")
    assert sampled.volume[groups["small"]] == pytest.approx(np.full(100, 0.02 / 100))
    assert sampled.volume[groups["large"]] == pytest.approx(np.full(100, 0.08 / 100))
    mass = Assembly(scene({"parts": parts, "spacing": 0.05}), particles({"parts": parts})).inputs({}).fields.mass
    assert mass.sum() == pytest.approx(2.0 * 0.1)


def test_a_count_and_a_spacing_exclude_each_other() -> None:
    body = {"shape": box([0.1, 0.1], [0.2, 0.2]), "sampling": {"lattice": {"count": 9}}, "spacing": 0.1}
    assert "bodies.b.spacing: has no meaning with lattice sampling, which has a count" in error_of(body)
    del body["spacing"]
    assert len(particles(body).x) == 81
    assert "9e+08 points that may be particles need" in error_of(body, "bodies.b.sampling.lattice.count=30000")


def test_values_by_group_reach_the_particles_of_their_part() -> None:
    parts = {"left": box([0.1, 0.1], [0.2, 0.2]), "right": box([0.3, 0.1], [0.2, 0.2])}
    loaded = scene({"parts": parts})
    sampled = sample(loaded)
    inputs = Assembly(loaded, sampled).inputs({E_PATH: np.array([5.0, 7.0])})
    E = inputs.terms[0][0][0]
    assert (E[sampled.groups("b")["left"]] == 5.0).all()
    assert (E[sampled.groups("b")["right"]] == 7.0).all()


def test_a_body_has_a_shape_or_parts() -> None:
    shape = box([0.1, 0.1], [0.2, 0.2])
    assert "bodies.b: must have exactly one of shape, parts; has none" in error_of({})
    assert "has shape, parts" in error_of({"shape": shape, "parts": {"a": shape}})
    assert "bodies.b.parts: must have at least 1 entry, has 0" in error_of({"parts": {}})


def test_parts_that_overlap_are_refused_and_those_that_touch_are_not() -> None:
    parts = {"a": box([0.1, 0.1], [0.2, 0.2]), "b": box([0.3, 0.1], [0.2, 0.2])}
    for sampling in ({}, {"sampling": {"jittered": {"amount": 1.0}}, "spacing": 0.05}):
        assert len(particles({"parts": parts, **sampling}).x) == 32
    message = error_of({"parts": {**parts, "c": box([0.4, 0.2], [0.2, 0.2])}})
    assert message.startswith("scene: bodies.b.parts.c: overlaps the part 'b', in about 25.0% of the smaller")


def test_thin_overlaps_of_parts_are_refused() -> None:
    torso = box([0.1, 0.5], [0.8, 0.2])

    def parts(overlap: float, **more: Any) -> dict[str, Any]:
        return {"parts": {"torso": torso, "leg": box([0.1, 0.1], [0.2, 0.4 + overlap])}, "spacing": 0.01, **more}

    assert "bodies.b.parts.leg: overlaps the part 'torso', in about 2.4% of the smaller" in error_of(parts(0.01))
    turned = {"place": {"angle": 17, "offset": [0.25, 0.05], "scale": 0.7}}
    assert "overlaps the part 'torso'" in error_of(parts(0.01, **turned))
    # parts that touch are accepted, even if their size is not a multiple of the spacing
    for sampling in ({}, turned, {"spacing": 0.016}, {"sampling": {"jittered": {"amount": 1.0}}}):
        assert len(particles(parts(0.0, **sampling)).x)


def test_the_error_names_a_part_without_particles() -> None:
    parts = {"a": box([0.1, 0.1], [0.2, 0.2]), "thin": {"ball": {"center": [0.6, 0.6], "radius": 0.01}}}
    ring = {"difference": [parts["thin"], {"ball": {"center": [0.6, 0.6], "radius": 0.009}}]}
    assert "scene: bodies.b.parts.thin: holds no particle" in error_of({"parts": {**parts, "thin": ring}})
    apart = [{"ball": {"center": [x, 0], "radius": 0.4}} for x in (0, 1)]
    assert "bodies.b.parts.a: the intersection is empty" in error_of({"parts": {"a": {"intersection": apart}}})


def test_bodies_of_parts_that_overlap_others_are_refused() -> None:
    two = scene({"parts": {"a": box([0.1, 0.1], [0.2, 0.2])}, "place": {"offset": [0.1, 0.0]}})
    data = two.model_dump(exclude_none=True)
    data["bodies"]["c"] = {**data["bodies"]["b"], "place": {"offset": [0.2, 0.0]}}
    with pytest.raises(SceneError, match=r"bodies.c.place: overlaps the body 'b' in 16 particles"):
        sample(load_scene(data))
