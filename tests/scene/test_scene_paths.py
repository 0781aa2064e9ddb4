"""Key paths: read, replace and describe a value, and name an unknown."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from cqrun.errors import SceneError
from cqrun.scene.load import load_scene, resolve
from cqrun.scene.paths import LeafInfo, canonical, get, leaf, leaves, with_values
from cqrun.scene.unknowns import start

Refused = Callable[..., list[str]]
E_PATH = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"
NU_PATH = "bodies.beam.material.elastic.fixed_corotated.poissons_ratio"
SHEAR = "bodies.beam.material.viscosity.shear"


def test_get_follows_choices_terms_lists_and_keys_with_dots(beam: str) -> None:
    scene = load_scene(beam)
    assert get(scene, E_PATH) == 2e5
    assert get(scene, SHEAR) == 100.0
    assert get(scene, "world.gravity.1") == -9.81
    assert get(scene, f"unknowns.{SHEAR}.bounds.1") == 400.0
    assert get(scene, "bodies.beam.groups.tip.box.corner") == [0.14, 0.04]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (
            "bodies.bean.material.density",
            "'bodies' has no 'bean' (did you mean 'bodies.beam.material.density'?)",
        ),
        (
            "bodies.beam.material.elastic.neo_hookean.youngs_modulus",
            "'bodies.beam.material.elastic' has no 'neo_hookean'",
        ),
        (
            "bodies.beam.material.incompressibility.bulk",
            "'bodies.beam.material' has no 'incompressibility': write the term there first, with a value to start from",
        ),
        (
            "bodies.beam.place.offset.0",
            "is not set in this scene: write it there first, with a value of 'offset.0' to start from",
        ),
        ("world.gravity.2", "'world.gravity' has no '2'"),
        ("wrld", "the scene has no 'wrld' (did you mean 'world'?); there are: cqrun, title"),
        ("", "is an empty path"),
    ],
)
def test_an_invalid_path_gets_a_suggestion(beam: str, path: str, message: str) -> None:
    scene = load_scene(beam)
    with pytest.raises(SceneError) as info:
        get(scene, path)
    assert message in str(info.value)


def test_leaf_returns_unit_range_and_whether_gradients_reach_it(beam: str) -> None:
    scene = load_scene(beam)
    assert leaf(scene, E_PATH) == LeafInfo(E_PATH, 2e5, "Pa", True, 0, None)
    assert leaf(scene, NU_PATH) == LeafInfo(NU_PATH, 0.45, "1", True, -1, 0.5)
    assert leaf(scene, "world.gravity.1") == LeafInfo("world.gravity.1", -9.81, "m/s^2", True, None, None)
    assert not leaf(scene, "world.dx").differentiable
    assert not leaf(scene, f"unknowns.{E_PATH}.bounds.0").differentiable


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("world.gravity", "is not a number but contains others: name one of world.gravity.0, world.gravity.1"),
        ("bodies.beam.material.elastic", "is not a number but contains others"),
        ("title", "must be a number, is 'a beam'"),
        ("bodies.beam.unit_mass", "must be a number, is False"),
        ("bodies.beam.spacing", "is not set in this scene: give it a value"),
    ],
)
def test_a_leaf_is_one_number(beam: str, path: str, message: str) -> None:
    with pytest.raises(SceneError) as info:
        leaf(load_scene(beam), path)
    assert message in str(info.value)


def test_leaves_that_gradients_reach(beam: str) -> None:
    scene = load_scene(beam)
    reached = set(leaves(scene, differentiable=True))
    assert {E_PATH, NU_PATH, SHEAR, "bodies.beam.material.density", "bodies.beam.velocity.0"} <= reached
    assert "world.gravity.1" in reached
    assert "world.dx" not in reached
    assert "bodies.beam.shape.box.size.0" in reached
    assert not any(".region." in path for path in reached)
    assert reached < set(leaves(scene))


def test_with_values_copies_and_keeps_values_bit_for_bit(beam: str, rng: np.random.Generator) -> None:
    scene = load_scene(beam)
    before = resolve(scene)
    value = np.float64(rng.uniform(1e5, 6e5))
    changed = with_values(scene, {E_PATH: value, "world.gravity": np.array([0.5, -1.0])})
    assert get(changed, E_PATH) == value
    assert get(changed, "world.gravity") == [0.5, -1.0]
    assert resolve(scene) == before
    assert changed.text == scene.text
    assert with_values(scene, {}) == scene


def test_with_values_can_add_a_named_part(beam: str) -> None:
    changed = with_values(load_scene(beam), {"boundaries.floor": {"slip": {"face": "y_min"}}})
    assert list(changed.boundaries) == ["clamp", "floor"]


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (NU_PATH, 0.5, "must be less than 0.5, is 0.5"),
        (SHEAR, float("nan"), "must be a finite number, is nan"),
        ("world.dz", 1.0, "unknown key; keys here: size, dx, frame, volume, contact, gravity"),
        ("world.gravity.9", 1.0, "there is no entry '9' in a list of 2"),
    ],
)
def test_with_values_refuses_what_the_field_refuses(beam: str, path: str, value: float, message: str) -> None:
    with pytest.raises(SceneError) as info:
        with_values(load_scene(beam), {path: value})
    assert f"{path}: {message}" in str(info.value)


def test_an_unknown_starts_at_initial_or_at_the_value_in_the_scene(beam: str) -> None:
    scene = load_scene(beam, [f"unknowns.{SHEAR}.initial=7"])
    assert start(scene, SHEAR) == 7.0
    assert start(scene, E_PATH) == 2e5


UNKNOWN = f"  {SHEAR}: {{bounds: [1, 400], scale: log}}"


@pytest.mark.parametrize(
    ("line", "messages"),
    [
        (
            f"  {NU_PATH}: {{bounds: [0.1, 0.5]}}",
            [
                f"beam.yaml:27:79: unknowns.{NU_PATH}.bounds.1: the bounds reach 0.5, but the value "
                "must be less than 0.5, is 0.5"
            ],
        ),
        (
            f"  {SHEAR}: {{bounds: [200, 400]}}",
            [
                f"beam.yaml:27:42: unknowns.{SHEAR}.bounds: the scene's own value 100 Pa s lies outside the "
                "bounds 200 to 400: widen them or give `initial`"
            ],
        ),
        (
            f"  {SHEAR}: {{bounds: [1, 400], initial: 500}}",
            [f"beam.yaml:27:69: unknowns.{SHEAR}.initial: the start 500 Pa s lies outside"],
        ),
        (
            "  world.dx: {bounds: [0.001, 0.01]}",
            ["beam.yaml:27:3: unknowns.world.dx: no gradient reaches it; unknowns can be: world.gravity.0,"],
        ),
        (
            "  bodies.bean.material.density: {bounds: [1, 2]}",
            [
                "beam.yaml:27:3: unknowns.bodies.bean.material.density: 'bodies' has no 'bean' "
                "(did you mean 'bodies.beam.material.density'?)"
            ],
        ),
        (
            "  world.gravity: {bounds: [-10, 0]}",
            ["beam.yaml:27:3: unknowns.world.gravity: is not a number but contains others: name one"],
        ),
        (
            "  world.gravity.1: {bounds: [-10, 0], per: group}",
            ["beam.yaml:27:44: unknowns.world.gravity.1.per: only a body's material, and an actuator's `weight`, can "],
        ),
        (
            f"  {SHEAR}: {{bounds: [1, 400], per: each}}",
            [f"beam.yaml:27:65: unknowns.{SHEAR}.per: must be 'body', 'group', 'particle' or 'field', is 'each'"],
        ),
    ],
)
def test_invalid_unknowns_are_refused(line: str, messages: list[str], refused: Refused) -> None:
    problems = refused(UNKNOWN, line)
    assert len(problems) == len(messages)
    for text, message in zip(problems, messages, strict=True):
        assert text.startswith(message)


def test_an_unknown_by_group_needs_groups(beam: str, refused: Refused) -> None:
    by_group = UNKNOWN.replace("scale: log", "per: group")
    assert load_scene(beam.replace(UNKNOWN, by_group)).unknowns[SHEAR].per == "group"
    without = "    groups:\n      tip: {box: {corner: [0.14, 0.04], size: [0.01, 0.02]}}\n"
    (problem,) = refused(without, "", f"unknowns.{SHEAR}.per=group")
    assert problem == (
        f"-o unknowns.{SHEAR}.per=group: unknowns.{SHEAR}.per: "
        "the body 'beam' has no groups; name some or use `per: body`"
    )


def test_two_spellings_name_the_same_value(beam: str) -> None:
    box = "{box: {corner: [0.05, 0.04], size: [0.1, 0.02]}}"
    scene = load_scene(beam.replace(f"shape: {box}", f"shape: {{union: [{box}]}}"))
    short, long = "bodies.beam.shape.union.0.box.size.0", "bodies.beam.shape.union.shapes.0.box.size.0"
    assert canonical(scene, short) == long
    assert get(scene, short) == get(scene, long) == 0.1
