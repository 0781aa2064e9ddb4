"""Key paths of the values that one recording alone has: read, replace, name as unknowns, and wrong ones."""

from __future__ import annotations

from typing import Any

import pytest

from cqrun.errors import SceneError
from cqrun.scene.load import dump, load_scene, resolve
from cqrun.scene.paths import LeafInfo, canonical, get, leaf, require_possible, with_values
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import has_own_values, own_unknowns, scene_of_recording, start

E_PATH = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"
OWN = "data.recordings.swing.overrides"
GRAVITY = f"{OWN}.world.gravity.0"
MARKERS = {"tip": [0.119, 0.065]}

BEAM: dict[str, Any] = {
    "cqrun": 1,
    "world": {"size": [0.16, 0.12], "dx": 0.01, "gravity": [0, -9.81], "frame": "updated"},
    "bodies": {
        "beam": {
            "shape": {"box": {"corner": [0.02, 0.06], "size": [0.1, 0.01]}},
            "particles_per_cell": 4,
            "material": {
                "density": 1000,
                "elastic": {"fixed_corotated": {"youngs_modulus": 3.0e4, "poissons_ratio": 0.3}},
            },
        }
    },
    "loads": {"air": {"damping": {"rate": 2.0}}},
    "time": {"duration": 0.1, "control_step": 0.01},
}


def scene_with(unknowns: dict[str, Any] | None = None, **swing: Any) -> Scene:
    """Return the beam with two recordings, `swing` and `rest`."""
    recordings = {
        "swing": {"file": "a.csv", "markers": MARKERS, **swing},
        "rest": {"file": "b.csv", "markers": MARKERS},
    }
    return load_scene({**BEAM, "data": {"recordings": recordings}, "unknowns": unknowns or {}})


def refusal(unknowns: dict[str, Any], **swing: Any) -> str:
    with pytest.raises(SceneError) as info:
        scene_with(unknowns, **swing)
    return str(info.value)


BOUNDS = {"bounds": [-3.0, 3.0]}

# --- read and replace -------------------------------------------------------------------------------------------


def test_a_recording_has_the_scenes_value_until_it_overrides_it() -> None:
    scene = scene_with()
    assert leaf(scene, f"{OWN}.world.gravity.1") == LeafInfo(f"{OWN}.world.gravity.1", -9.81, "m/s^2", True, None, None)
    own = scene_with(overrides={"world.gravity": [0.5, -9.7]})
    assert [leaf(own, f"{OWN}.world.gravity.{k}").value for k in (0, 1)] == [0.5, -9.7]
    assert leaf(own, "data.recordings.rest.overrides.world.gravity.0").value == 0
    assert get(own, f"{OWN}.world.gravity") == [0.5, -9.7]


def test_a_part_that_one_recording_alone_has() -> None:
    push = {"point_force": {"body": "beam", "force": [0.0, -0.1]}}
    scene = scene_with(overrides={"loads.push": push})
    path = f"{OWN}.loads.push.point_force.force.1"
    assert leaf(scene, path).value == -0.1
    changed = with_values(scene, {path: -0.2})
    assert leaf(changed, path).value == -0.2
    assert get(scene_of_recording(changed, "swing"), "loads.push.point_force.force") == [0.0, -0.2]
    with pytest.raises(SceneError, match="'loads' has no 'push'"):
        leaf(scene, "data.recordings.rest.overrides.loads.push.point_force.force.1")


def test_a_value_is_replaced_where_it_is_given_or_beside() -> None:
    """Inside the override that contains it; as an override of its own if there is none, or if that has the default."""
    scene = with_values(scene_with(overrides={"world.gravity": [0.5, -9.7]}), {GRAVITY: 0.7})
    assert scene.recordings["swing"].overrides == {"world.gravity": [0.7, -9.7]}
    scene = with_values(with_values(scene_with(), {GRAVITY: 0.7}), {GRAVITY: 0.8})
    assert scene.recordings["swing"].overrides == {"world.gravity.0": 0.8}
    block = {"shape": {"box": {"corner": [0.02, 0.1], "size": [0.02, 0.01]}}, "particles_per_cell": 4,
             "material": BEAM["bodies"]["beam"]["material"]}  # fmt: skip
    velocity = f"{OWN}.bodies.block.velocity.1"
    scene = with_values(scene_with(overrides={"bodies.block": block}), {velocity: 0.3})
    assert "bodies.block.velocity.1" in scene.recordings["swing"].overrides
    assert leaf(scene, velocity).value == 0.3


def test_the_long_form_of_an_own_path() -> None:
    union = {"union": [{"box": {"corner": [0.02, 0.06], "size": [0.1, 0.01]}}]}
    scene = scene_with(overrides={"bodies.beam.shape": union})
    short, long = (f"{OWN}.bodies.beam.shape.union.{k}.box.corner.0" for k in ("0", "shapes.0"))
    assert canonical(scene, short) == long
    assert leaf(scene, short).differentiable


def test_an_offset_that_is_zero_is_not_written() -> None:
    """So the names of older runs stay the same. A key path finds it all the same."""
    scene = scene_with()
    assert "offset" not in dump(resolve(scene))
    assert leaf(scene, "data.recordings.swing.offset.1") == LeafInfo(
        "data.recordings.swing.offset.1", 0.0, "m", True, None, None
    )
    moved = with_values(scene, {"data.recordings.swing.offset.1": 1e-3})
    assert load_scene(resolve(moved)).recordings["swing"].offset == [0.0, 1e-3]


# --- unknowns ---------------------------------------------------------------------------------------------------


def test_the_scene_of_a_recording_has_its_unknowns_as_its_own() -> None:
    tied = f"{OWN}.world.gravity.1"
    scene = scene_with({
        E_PATH: {"bounds": [1e4, 1e5], "scale": "log"},
        "world.gravity.0": BOUNDS,
        GRAVITY: BOUNDS,
        "data.recordings.rest.overrides.loads.air.damping.rate": {
            "bounds": [1.0, 4.0], "also": {tied: {"factor": -1.0, "offset": -8.0}},
        },
    }, overrides={"world.gravity": [0.5, -10.0]})  # fmt: skip
    swing, rest = (scene_of_recording(scene, name) for name in ("swing", "rest"))
    assert set(swing.unknowns) == {E_PATH, "world.gravity.0", "world.gravity.1"}
    assert set(rest.unknowns) == {E_PATH, "world.gravity.0", "loads.air.damping.rate"}
    assert start(swing, "world.gravity.0") == 0.5
    assert start(rest, "world.gravity.0") == 0
    assert (swing.unknowns["world.gravity.1"].bounds, start(swing, "world.gravity.1")) == ([-12.0, -9.0], -10.0)
    assert own_unknowns(scene, "swing") == ["world.gravity.0", "world.gravity.1"]
    assert own_unknowns(scene, "rest") == ["loads.air.damping.rate"]
    assert has_own_values(scene, "rest")
    assert not has_own_values(scene_with({E_PATH: {"bounds": [1e4, 1e5]}}), "rest")


def test_an_own_value_may_start_from_an_override_of_what_others_share() -> None:
    scene = scene_with({"world.gravity.0": BOUNDS, GRAVITY: BOUNDS}, overrides={"world.gravity.0": 0.5})
    assert start(scene, GRAVITY) == 0.5
    message = refusal({"world.gravity.0": BOUNDS}, overrides={"world.gravity": [0.5, -9.7]})
    assert "is fitted, as the unknown 'world.gravity.0': a recording cannot have its own value" in message
    assert f"to fit one for this recording alone, add the unknown '{GRAVITY}'" in message


def test_values_that_are_impossible_in_the_scene_of_a_recording() -> None:
    scene = scene_with()
    with pytest.raises(SceneError, match=rf"{OWN}.loads.air.damping.rate: must be at least 0, is -1"):
        require_possible(scene, {f"{OWN}.loads.air.damping.rate": -1.0})
    message = refusal({f"{OWN}.loads.air.damping.rate": {"bounds": [-1.0, 4.0]}})
    assert "the bounds reach -1, but the value must be at least 0, is -1" in message
    message = refusal({f"{OWN}.loads.air.damping.rate": {"bounds": [3.0, 4.0]}})
    assert "the scene's own value 2 1/s lies outside the bounds 3 to 4" in message


WRONG = {
    "a recording that does not exist": (
        "data.recordings.swin.overrides.world.gravity.0",
        "'data.recordings' has no 'swin' (did you mean 'swing'?); there are: swing, rest",
    ),
    "a path without `overrides`": (
        "data.recordings.swing.world.gravity.0",
        f"'data.recordings.swing' has no 'world': the value that this recording alone has there is '{GRAVITY}'",
    ),
    "the end of such a path": (
        "data.recordings.swing.gravity.0",
        f"'data.recordings.swing' has no 'gravity': the value that this recording alone has there is '{GRAVITY}'",
    ),
    "a word for it": (
        "data.recordings.swing.tilt",
        "any other value of this recording alone is data.recordings.swing.overrides.PATH, such as world.gravity.0 for",
    ),
    "a misspelt path": (f"{OWN}.world.gravty.0", f"'world' has no 'gravty' (did you mean '{GRAVITY}'?)"),
    "a vector": (f"{OWN}.world.gravity", f"is not a number but contains others: name one of {GRAVITY}"),
    "a number that no gradient reaches": (f"{OWN}.world.dx", f"unknowns can be: {GRAVITY}, {OWN}.world.gravity.1"),
    "what all recordings share": (f"{OWN}.time.duration", "all recordings share `time`: one recording can have its"),
    "the start in the wrong place": (f"{OWN}.data.recordings.swing.start", "all recordings share `data`"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_path_says_what_would_be_right(name: str) -> None:
    path, message = WRONG[name]
    assert message in refusal({path: BOUNDS})


def test_what_an_own_value_cannot_be() -> None:
    assert "held out, so nothing determines its own value of world.gravity.0" in refusal(
        {GRAVITY: BOUNDS}, holdout=True
    )
    offset = "data.recordings.swing.offset.0"
    assert "held out, so nothing determines its own value of offset.0" in refusal({offset: BOUNDS}, holdout=True)
    modulus = f"{OWN}.{E_PATH}"
    groups = {"bounds": [1e4, 1e5], "per": "particle"}
    assert "`per: particle` is for values that all recordings share; use `per: body`" in refusal({modulus: groups})
    also = {GRAVITY: {**BOUNDS, "also": ["world.gravity.0"]}}
    assert "all recordings share it, so it cannot follow a value of one of them: make it the unknown" in refusal(also)
    twice = {GRAVITY: BOUNDS, "world.gravity.0": {**BOUNDS, "also": [GRAVITY]}}
    assert f"is the same value as the unknown '{GRAVITY}': name it once" in refusal(twice)


def test_one_value_for_each_recording_is_named_by_key_paths() -> None:
    message = refusal({"world.gravity.0": {**BOUNDS, "per": "recording"}})
    assert "per: name the value of each recording: `data.recordings.NAME.overrides.` before the key path" in message


def test_overrides_that_are_wrong_are_named_once_and_where_they_are() -> None:
    message = refusal({GRAVITY: BOUNDS}, overrides={"world.gravity": "down"})
    assert "data.recordings.swing.overrides.world.gravity: must be a list" in message
