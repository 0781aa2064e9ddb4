"""The section `path`: one message for one mistake, at its place, without names of Python."""

from __future__ import annotations

from typing import Any

import pytest

from cqrun.errors import SceneError
from cqrun.scene.load import load_scene
from cqrun.scene.load_path import Ramp

KEY = "boundaries.clamp.sticky.rotation.0"
BODY = {
    "shape": {"box": {"corner": [0.02, 0.1], "size": [0.2, 0.03]}},
    "particles_per_cell": 4,
    "material": {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}}},
}


def scene(path: Any, **more: Any) -> dict[str, Any]:
    clamp = {"region": {"box": {"corner": [0, 0], "size": [0.04, 0.2]}}, "rotation": [0]}
    return {
        "cqrun": 1, "job": "rest", "world": {"size": [0.3, 0.2], "dx": 0.01}, "bodies": {"beam": BODY},
        "boundaries": {"clamp": {"sticky": clamp}}, "path": path, **more,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("entry", "place", "message"),
    [
        ([], "", "must have at least 1 entry, has 0"),
        (5, "", "must be a list of values, or a ramp with `first`, `last` and `points`, is 5"),
        (None, "", "must be a list of values, or a ramp with `first`, `last` and `points`, is empty"),
        ([0.0, "a"], ".1", "must be a number, is 'a'"),
        ([float("nan")], ".0", "must be a finite number, is nan"),
        ({"first": 0, "last": 1, "points": 1}, ".points", "must be at least 2, is 1"),
        ({"first": 0, "last": 1}, ".points", "is missing: Number of values"),
        ({"first": 0, "last": float("inf"), "points": 3}, ".last", "must be a finite number, is inf"),
    ],
)
def test_a_bad_entry_has_one_message_at_its_place(entry: Any, place: str, message: str) -> None:
    with pytest.raises(SceneError) as error:
        load_scene(scene({KEY: entry}))
    (problem,) = error.value.problems
    assert (problem.path, problem.message) == (f"path.{KEY}{place}", message)


def test_lists_and_ramps_are_read() -> None:
    ramp = {"first": 0, "last": 1, "points": 3}
    assert load_scene(scene({KEY: [0, 0.5]})).path[KEY] == [0.0, 0.5]
    assert load_scene(scene({KEY: ramp})).path[KEY] == Ramp(first=0, last=1, points=3)


# --- scenes without time ----------------------------------------------------------------------------------------------


POSES = {"file": "a.csv", "poses": {"loads": {"g": "world.gravity.1"}, "markers": {"tip": [0.2, 0.11]}}}
MARKERS = {"file": "b.csv", "markers": {"tip": [0.2, 0.11]}}


def fit(recordings: dict[str, Any], **more: Any) -> dict[str, Any]:
    unknown = "bodies.beam.material.elastic.neo_hookean.youngs_modulus"
    data = {"data": {"recordings": recordings}, "unknowns": {unknown: {"bounds": [1e4, 1e6]}}}
    return {**scene({}), "job": "sysid", **data, **more}


def test_a_fit_to_bodies_at_rest_alone_needs_no_time() -> None:
    given = {"duration": 0.01, "control_step": 0.01}
    without, timed = load_scene(fit({"a": POSES})), load_scene(fit({"a": POSES}, time=given))
    assert without.model_dump() == timed.model_dump()


@pytest.mark.parametrize("recordings", [{"b": MARKERS}, {"a": POSES, "b": MARKERS}, {"c": {"file": "c.csv"}}])
def test_a_fit_to_a_motion_needs_its_time(recordings: dict[str, Any]) -> None:
    with pytest.raises(SceneError, match="time: is missing: Duration and steps"):
        load_scene(fit(recordings))
