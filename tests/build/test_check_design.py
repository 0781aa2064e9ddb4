"""Unknowns of a design: bounds at which a body is not valid, and values that are tied to an unknown."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.fitting.cases import make_cases
from cqrun.jobs.gradcheck import run_gradcheck
from cqrun.jobs.table import report_lines
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene

E = "material.elastic.neo_hookean.youngs_modulus"
MATERIAL = {"density": 1.0, "elastic": {"neo_hookean": {"youngs_modulus": 10.0, "poissons_ratio": 0.3}}}


def box(x: float, y: float = 0.25, per_cell: int = 4) -> dict[str, Any]:
    """Return a body of size 0.25 by 0.5, with 8 by 16 particles or more."""
    shape = {"box": {"corner": [x, y], "size": [0.25, 0.5]}}
    return {"shape": shape, "particles_per_cell": per_cell, "material": MATERIAL}


def data(unknowns: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return a scene with two bodies next to each other."""
    return {
        "cqrun": 1,
        "world": {"size": [1, 1], "dx": 0.0625, "gravity": [0, -1], "frame": "updated"},
        "bodies": {"a": box(0.125), "b": box(0.625)},
        "unknowns": unknowns,
        "time": {"duration": 0.02, "control_step": 0.01},
        **more,
    }


def denser(body: str) -> dict[str, Any]:
    """Return the rest of a scene whose data, over 0.08 s, come from a denser body."""
    truth = {f"bodies.{body}.material.density": 1.4}
    return {
        "data": {"synthetic": {"truth": truth, "body": body, "tracked": 10, "key_frames": 5}},
        "time": {"duration": 0.08, "control_step": 0.02},
    }


def assert_gradients_agree(scene: dict[str, Any], folder: Path) -> None:
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump(scene))
    run, agrees = run_gradcheck(path, [], folder, fresh=True, threads=2)
    assert agrees, "\n".join(report_lines(run))


BAD = {
    "outside": (
        {"bodies.a.shape.box.corner.0": {"bounds": [-0.5, 0.2]}},
        "unknowns.bodies.a.shape.box.corner.0.bounds: at -0.5 bodies.a.shape reaches x = -0.484375 m, below 0 m",
    ),
    "overlapping": (
        {"bodies.a.shape.box.size.0": {"bounds": [0.2, 0.7]}},
        "unknowns.bodies.a.shape.box.size.0.bounds: at 0.7 bodies.b.shape overlaps the body 'a'",
    ),
    "towards each other": (
        {"bodies.a.shape.box.corner.0": {"bounds": [0.1, 0.3]}, "bodies.b.shape.box.corner.0": {"bounds": [0.45, 0.7]}},
        "with bodies.a.shape.box.corner.0 at 0.3 and bodies.b.shape.box.corner.0 at 0.45 bodies.b.shape overlaps",
    ),
    "sparse": (
        {"bodies.a.shape.box.size.1": {"bounds": [0.3, 0.6]}},
        "at 0.6 bodies.a has particles 0.0375 m apart, fewer than two in a cell of 0.0625 m",
    ),
    "of another kind": (
        {f"bodies.a.{E}": {"bounds": [5, 20], "per": "particle", "also": ["bodies.b.material.density"]}},
        "`per: particle` can be tied to the same value of another body only",
    ),
    "no such number": (
        {f"bodies.a.{E}": {"bounds": [5, 20], "also": ["bodies.b.material.densty"]}},
        "'bodies.b.material' has no 'densty'",
    ),
    "without adjoint": (
        {f"bodies.a.{E}": {"bounds": [5, 20], "also": ["world.dx"]}},
        "unknowns.bodies.a.material.elastic.neo_hookean.youngs_modulus.also.world.dx: no gradient reaches it",
    ),
    "twice": (
        {f"bodies.a.{E}": {"bounds": [5, 20], "also": [f"bodies.b.{E}"]}, f"bodies.b.{E}": {"bounds": [5, 20]}},
        f"is the same value as the unknown 'bodies.b.{E}': name it once",
    ),
    "a follower's bound": (
        {f"bodies.a.{E}": {"bounds": [5, 20], "also": {f"bodies.b.{E}": {"offset": -5}}}},
        f"the bounds reach 5, but by `also`, bodies.b.{E} must be greater than 0, is 0",
    ),
    "a factor of nothing": (
        {f"bodies.a.{E}": {"bounds": [5, 20], "also": {f"bodies.b.{E}": {"factor": 0}}}},
        "must not be 0, or the number is constant",
    ),
}


CORNER, SIZE, OTHER = "bodies.a.shape.box.corner.0", "bodies.a.shape.box.size.0", "bodies.b.shape.box.corner.0"

BAD_TOGETHER = {
    "two": (
        {CORNER: [0.1, 0.3], SIZE: [0.2, 0.4]},
        f"with {CORNER} at 0.3 and {SIZE} at 0.4 bodies.b.shape overlaps the body",
    ),
    "three": (
        {CORNER: [0.1, 0.3], SIZE: [0.2, 0.4], OTHER: [0.6, 0.7]},
        f"with {CORNER} at 0.3 and {SIZE} at 0.4 and {OTHER} at 0.6 bodies.b.shape overlaps the body",
    ),
    "two of four": (
        {CORNER: [0.1, 0.3], SIZE: [0.2, 0.4], OTHER: [0.6, 0.7], "bodies.b.shape.box.size.1": [0.4, 0.5]},
        f"with {CORNER} at 0.3 and {SIZE} at 0.4 bodies.b.shape overlaps the body",
    ),
    "an angle between its bounds": (
        {"bodies.a.place.angle": [0, 360]},
        "at 30 bodies.a.place reaches x = -0.",
    ),
    "an angle half way between near bounds": (
        {"bodies.a.place.angle": [30, 60]},
        "at 45 bodies.a.place reaches x = -0.",
    ),
    "past another body": (
        {CORNER: [0.02, 0.72]},
        f"unknowns.{CORNER}.bounds: at 0.253333 bodies.b.shape overlaps the body 'a'",
    ),
    "next to nothing": (
        {SIZE: [1e-9, 0.3]},
        "at 1e-09 a part of a body has less than 0.0001 times its volume at the start",
    ),
    "sparse from the start": (
        {SIZE: [0.2, 0.3]},
        "at 0.3 bodies.a has particles 0.0433 m apart, fewer than two in a cell of 0.0625 m",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_TOGETHER)
def test_combinations_of_bounds_and_values_between_them_are_checked(name):
    bounds, message = BAD_TOGETHER[name]
    bodies = {"a": box(0.125, per_cell=3 if "sparse" in name else 16), "b": box(0.625)}
    if "angle" in name:
        bodies["a"] |= {"place": {"angle": 0.0}}
    if "half way" in name:
        square = {"box": {"corner": [-0.2, -0.2], "size": [0.4, 0.4]}}
        bodies = {"a": box(0.0, per_cell=16) | {"shape": square, "place": {"offset": [0.268, 0.5], "angle": 30.0}}}
    if "past" in name:
        bodies["b"] = box(0.45)
    with pytest.raises(SceneError, match=re.escape(message)):
        build(load_scene(data({path: {"bounds": ends} for path, ends in bounds.items()}, bodies=bodies)))


def test_a_polygon_that_crosses_itself_is_refused_if_its_corners_are_unknowns():
    corner = "bodies.a.shape.polygon.points.2.0"
    scene = data({corner: {"bounds": [0.1, 0.2]}})
    scene["bodies"]["a"]["shape"] = {"polygon": {"points": [[0.1, 0.25], [0.4, 0.75], [0.15, 0.75], [0.4, 0.25]]}}
    with pytest.raises(SceneError, match=rf"unknowns.{corner}: a polygon whose corners are unknowns must not cross"):
        build(load_scene(scene))


def test_a_warning_says_that_a_cutting_shape_follows_the_unknown_shape():
    body = box(0.125, per_cell=9)
    hole = {"box": {"corner": [0.1875, 0.4375], "size": [0.125, 0.125]}}
    body["shape"] = {"difference": [body["shape"], hole]}

    def warned(path: str) -> list[str]:
        reach = {"there": {"reach": {"body": "a", "position": [0.5, 0.5]}}}
        scene = data({path: {"bounds": [0.2, 0.25]}}, objective=reach)
        scene["bodies"]["a"] = body
        return [str(problem) for problem in build(load_scene(scene)).warnings if "that cut it" in str(problem)]

    first = "bodies.a.shape.difference.0.box.size.0"
    (warning,) = warned(first)
    message = "changes the first shape of a difference: the shapes that cut it move and stretch with it"
    assert f"unknowns.{first}: {message}" in warning
    assert not warned("bodies.b.shape.box.size.0")


def test_a_mirrored_field_of_an_asymmetric_body_is_a_warning():
    scene = data({f"bodies.a.{E}": {"bounds": [5, 20], "per": "field", "mirror": "x"}})
    assert not [problem for problem in build(load_scene(scene)).warnings if "mirror" in str(problem)]
    foot = {"box": {"corner": [0.125, 0.125], "size": [0.125, 0.125]}}
    scene["bodies"]["a"] = {**scene["bodies"]["a"], "parts": {"body": box(0.125)["shape"], "foot": foot}}
    del scene["bodies"]["a"]["shape"]
    (warning,) = [str(problem) for problem in build(load_scene(scene)).warnings if "mirror" in str(problem)]
    assert "'a' is not its own mirror image across x: the mirror images of 11% of its particles lie" in warning


@pytest.mark.parametrize("name", BAD)
def test_bad_unknowns(name):
    unknowns, message = BAD[name]
    with pytest.raises(SceneError, match=re.escape(message)):
        build(load_scene(data(unknowns)))


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
def test_the_length_of_a_cable_follows_its_body(dim, tmp_path):
    """Compare gradients with differences for a taut, bent cable and a slack one on a bar of variable shape."""
    ends = [0.2] * (dim - 2)

    def cable(*route: list[float]) -> dict[str, Any]:
        return {"cable": {"body": "a", "route": [[*point, *[0.25] * (dim - 2)] for point in route], "stiffness": 2}}

    angle, turned = (10, "angle") if dim == 2 else ([10, 0, 0], "rotation.0")
    bar = {"box": {"corner": [0.3, 0.2, *ends], "size": [0.2, 0.4, *ends]}}
    scene = {
        "cqrun": 1,
        "world": {
            "size": [1] * dim,
            "dx": 0.0625 if dim == 2 else 0.08,
            "gravity": [0, -1, *[0] * (dim - 2)],
            "frame": "updated",
        },
        "bodies": {
            "a": {
                "shape": bar, "place": {turned.partition(".")[0]: angle}, "particles_per_cell": 3**dim,
                "material": MATERIAL,
            }
        },
        "actuators": {
            "taut": cable([0.33, 0.25], [0.36, 0.4], [0.33, 0.55]), "slack": cable([0.45, 0.25], [0.45, 0.5]),
        },
        "activation": {"signals": {"taut": [0.7] * 4, "slack": [1.0] * 4}},
        "boundaries": {"floor": {"sticky": {"face": "y_min"}}},
        "unknowns": {
            "bodies.a.shape.box.size.1": {"bounds": [0.38, 0.44]},
            f"bodies.a.place.{turned}": {"bounds": [5, 15]},
            "bodies.a.material.density": {"bounds": [0.5, 2]},
        },
        **denser("a"),
    }  # fmt: skip
    assert_gradients_agree(scene, tmp_path)


def test_tied_values_of_bodies_that_do_not_match_are_refused():
    """Values per particle need bodies with the same particles, values per group need the same groups."""
    scene = data({f"bodies.a.{E}": {"bounds": [5, 20], "per": "particle", "also": [f"bodies.b.{E}"]}})
    assert make_params(build(load_scene(scene))).blocks[0].followers[0].order is not None
    scene["bodies"]["b"]["shape"]["box"]["size"] = [0.25, 0.45]
    with pytest.raises(SceneError, match=r"the 112 particles of 'b' are not the 128 of 'a' in another place"):
        make_params(build(load_scene(scene)))
    scene["unknowns"][f"bodies.a.{E}"]["per"] = "group"
    half = {"box": {"corner": [0, 0], "size": [1, 0.5]}}
    scene["bodies"]["a"]["groups"], scene["bodies"]["b"]["groups"] = {"low": half}, {"base": half}
    with pytest.raises(SceneError, match="'b' has the groups base, 'a' has low: they must match"):
        make_params(build(load_scene(scene)))


@pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
def test_gradients_by_geometry_through_a_rollout(dim, tmp_path):
    """Compare with differences for every number in the shapes of two falling, spinning bodies, one of them placed."""
    ends = [0.2] * (dim - 2)
    place = {"offset": [0.45, 0.5, *[0.3] * (dim - 2)], **({"angle": 20} if dim == 2 else {"rotation": [10, 0, 20]})}
    ball = {"ball": {"center": [0.0] * dim, "radius": 0.12}}
    bodies = {
        "a": {"shape": ball, "place": place, "particles_per_cell": 3**dim, "material": MATERIAL},
        "b": {
            "shape": {"box": {"corner": [0.6, 0.08, *ends], "size": [0.2, 0.3, *ends]}},
            "particles_per_cell": 3**dim, "material": MATERIAL, "spin": [2.0] * (1 if dim == 2 else 3),
        },
    }  # fmt: skip
    turn = "angle" if dim == 2 else "rotation.2"
    unknowns = {
        "bodies.a.shape.ball.radius": {"bounds": [0.1, 0.13]},
        f"bodies.a.place.{turn}": {"bounds": [10, 40]},
        "bodies.b.shape.box.size.0": {
            "bounds": [0.15, 0.22], "also": {"bodies.a.place.scale": {"factor": 2, "offset": 0.6}}
        },
        "bodies.b.shape.box.corner.1": {"bounds": [0.07, 0.1]},
        "bodies.b.material.density": {"bounds": [0.5, 2]},
    }  # fmt: skip
    scene = {
        "cqrun": 1,
        "world": {
            "size": [1] * dim,
            "dx": 0.0625 if dim == 2 else 0.08,
            "gravity": [0, -3, *[0] * (dim - 2)],
            "frame": "updated",
        },
        "bodies": bodies,
        "boundaries": {"floor": {"friction": {"face": "y_min", "coefficient": 0.4}}},
        "unknowns": unknowns,
        **denser("b"),
    }  # fmt: skip
    assert_gradients_agree(scene, tmp_path)


def test_a_body_starts_at_the_start_values_of_its_unknowns():
    unknowns = {"bodies.a.shape.box.size.1": {"bounds": [0.3, 0.5], "initial": 0.4}}
    built = build(load_scene(data(unknowns)))
    params = make_params(built)
    x = built.assembly.inputs(params.unpack(params.start)).state.x[built.particles.of("a")]
    assert np.ptp(x[:, 1]) == pytest.approx(0.4 * 15 / 16)


def test_the_short_spelling_of_a_path_in_a_union():
    """`union.0` is `union.shapes.0`, in an unknown, in a tied value and in a truth."""
    ties = ["bodies.b.shape.union.0.box.size.1"]
    scene = data({"bodies.a.shape.union.0.box.size.1": {"bounds": [0.4, 0.5], "also": ties}})
    for body in scene["bodies"].values():
        body["shape"] = {"union": [body["shape"]]}
    scene["data"] = {"synthetic": {"truth": {"bodies.a.shape.union.0.box.size.1": 0.45}, "body": "a", "tracked": 5,
                                   "key_frames": 3}}  # fmt: skip
    built = build(load_scene(scene))
    params = make_params(built)
    x = built.assembly.inputs(params.unpack(np.zeros(1))).state.x
    assert [np.ptp(x[built.particles.of(body), 1]) for body in "ab"] == pytest.approx([0.4 * 15 / 16] * 2)
    (case,) = make_cases(built)
    assert len(case.comparisons) == 1


PARTS = {"floor": {"box": {"corner": [0.2, 0.2], "size": [0.4, 0.05]}},
         "wall": {"box": {"corner": [0.3, 0.25], "size": [0.1, 0.2]}}}  # fmt: skip


def test_parts_that_meet_at_a_corner_alone_come_apart():
    corner = {"bodies.a.parts.wall.box.corner.0": {"bounds": [0.3, 0.6]}}
    bodies = {"a": {"parts": PARTS, "particles_per_cell": 16, "material": MATERIAL}}
    with pytest.raises(SceneError, match=r"at 0\.6 bodies\.a\.parts\.\w+ comes apart from the rest of the body"):
        build(load_scene(data(corner, bodies=bodies, **denser("a"))))


def test_parts_that_others_hold_together_may_part():
    """Two walls that touch each other stand on one floor; one becomes thinner."""
    second = {"box": {"corner": [0.4, 0.25], "size": [0.1, 0.2]}}
    bodies = {"a": {"parts": PARTS | {"second": second}, "particles_per_cell": 16, "material": MATERIAL}}
    thinner = {"bodies.a.parts.wall.box.size.0": {"bounds": [0.05, 0.1]}}
    build(load_scene(data(thinner, bodies=bodies, **denser("a"))))


@pytest.mark.parametrize(
    ("unknowns", "message"),
    [
        ({"bodies.a.parts.wall.box.size.0": {"bounds": [0.05, 0.15]}}, None),
        ({"bodies.a.parts.wall.box.corner.0": {"bounds": [0.25, 0.4]}}, None),
        (
            {"bodies.a.parts.wall.box.corner.1": {"bounds": [0.25, 0.3]}},
            r"at 0\.3 bodies\.a\.parts\.\w+ comes apart from the rest of the body",
        ),
    ],
    ids=["thicker", "sliding", "apart"],
)
def test_parts_may_slide_along_each_other_and_not_come_apart(unknowns, message):
    bodies = {"a": {"parts": PARTS, "particles_per_cell": 16, "material": MATERIAL}}
    scene = load_scene(data(unknowns, bodies=bodies, **denser("a")))
    if message is None:
        build(scene)
        return
    with pytest.raises(SceneError, match=message):
        build(scene)
