"""Placement: bodies are inside the world and apart from each other, and regions hold particles."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import trimesh

from cqrun.build import check_particles as check
from cqrun.build.particles import fill
from cqrun.build.regions import BodyPoints
from cqrun.errors import SceneError
from cqrun.geometry.shape import ChosenShape
from cqrun.plugin import registry
from cqrun.plugin.contract import Plugin
from cqrun.plugin.reference import BodyName
from cqrun.scene.load import load_scene
from cqrun.scene.paths import with_values
from cqrun.scene.schema import Scene


def two_balls(**second: Any) -> Scene:
    material = {"density": 1.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0, "poissons_ratio": 0.3}}}
    common = {"particles_per_cell": 4, "material": material}
    left = {"shape": {"ball": {"center": [0.3, 0.5], "radius": 0.1}}, **common}
    right = {"shape": {"ball": {"center": [0.6, 0.5], "radius": 0.1}}, **common, **second}
    return load_scene(
        {
            "cqrun": 1,
            "world": {"size": [1, 1], "dx": 0.02, "frame": "updated"},
            "bodies": {"left": left, "right": right},
            "time": {"duration": 1.0, "control_step": 0.1},
        }
    )


def sampled(scene: Scene) -> tuple[dict[str, BodyPoints], dict[str, np.ndarray]]:
    points, volumes = {}, {}
    for name in scene.bodies:
        points[name], volumes[name] = fill(scene, name)
    return points, volumes


def problems(scene: Scene, margin: float = 0.0) -> list[str]:
    return [str(p) for p in check.geometry_problems(scene, sampled(scene)[0], margin)]


def test_a_valid_placement_has_no_problems() -> None:
    scene = two_balls()
    assert problems(scene) == []
    assert check.sparse_bodies(scene, sampled(scene)[1]) == []


def test_the_error_of_a_body_outside_the_world_says_where_and_how_far() -> None:
    (message,) = problems(two_balls(shape={"ball": {"center": [0.95, 0.5], "radius": 0.1}}))
    assert message.startswith("scene: bodies.right.shape: reaches x = 1.045 m, above 1 m: the world holds")
    inside = two_balls(shape={"ball": {"center": [0.89, 0.5], "radius": 0.1}})
    assert problems(inside) == []
    assert "above 0.96 m: the world holds particles from 0.04 to 0.96 m" in problems(inside, margin=0.04)[0]
    both = problems(two_balls(shape={"ball": {"center": [0.02, 0.02], "radius": 0.1}}))
    assert ["reaches x" in both[0], "reaches y" in both[1], len(both)] == [True, True, 2]


def test_the_error_of_a_body_outside_the_world_names_the_part_that_reaches_out() -> None:
    parts = {
        "head": {"ball": {"center": [0.6, 0.5], "radius": 0.05}},
        "hand": {"ball": {"center": [0.99, 0.5], "radius": 0.05}},
        "arm": {"box": {"corner": [0.7, 0.48], "size": [0.2, 0.04]}},
        "foot": {"box": {"corner": [0.6, -0.02], "size": [0.04, 0.1]}},
    }
    scene = with_values(two_balls(shape=None, parts=parts), {})
    messages = problems(scene)
    assert [message.partition(": reaches")[0] for message in messages] == [
        "scene: bodies.right.parts.hand",
        "scene: bodies.right.parts.foot",
    ]


def test_the_error_of_overlapping_bodies_says_where() -> None:
    (message,) = problems(two_balls(shape={"ball": {"center": [0.45, 0.5], "radius": 0.1}}))
    assert message.startswith("scene: bodies.right.shape: overlaps the body 'left' in ")
    assert "such as at (0." in message


def test_of_many_overlapping_parts_some_pairs_are_told() -> None:
    parts = {f"p{k}": {"ball": {"center": [0.6, 0.5], "radius": 0.05}} for k in range(60)}
    messages = problems(with_values(two_balls(shape=None, parts=parts), {}))
    assert len(messages) == check.MOST_PAIRS
    assert messages[0].startswith(
        "scene: bodies.right.parts.p1: overlaps the part 'p0', in about 100.0% of the smaller"
    )


def test_bodies_may_touch() -> None:
    box = {"box": {"corner": [0.4, 0.45], "size": [0.1, 0.1]}}
    scene = two_balls(shape=box)
    assert problems(scene) == []


def test_a_small_body_inside_another_is_refused_once() -> None:
    small = {"ball": {"center": [0.3, 0.5], "radius": 0.02}}
    assert len(problems(two_balls(shape=small))) == 1


def test_a_body_thinner_than_its_spacing_has_no_particles() -> None:
    thin = {"polygon": {"points": [[0.6, 0.5], [0.7, 0.5], [0.7, 0.5001]]}}
    (message,) = problems(two_balls(shape=thin))
    assert message.startswith("scene: bodies.right.shape: holds no particle")


def test_the_error_of_an_empty_group_says_where_the_body_is() -> None:
    groups = {
        "in": {"half_space": {"point": [0.6, 0.5], "normal": [1, 0]}},
        "out": {"half_space": {"point": [0.2, 0.5], "normal": [1, 0]}},
    }
    (message,) = problems(two_balls(groups=groups))
    assert message.startswith("scene: bodies.right.groups.out: holds no particle: 'right' lies within (0.505, ")
    (placed,) = problems(two_balls(groups=groups, place={"offset": [0.1, 0.0]}))  # groups are in shape coordinates
    assert "'right' lies within (0.505, " in placed
    assert placed.endswith("m before it is placed")


@pytest.mark.parametrize(("per_cell", "warned"), [(4, False), (9, False), (3.9, True), (1, True)])
def test_few_particles_per_cell_are_a_warning(per_cell: float, warned: bool) -> None:
    scene = two_balls(particles_per_cell=per_cell)
    warnings = [str(p) for p in check.sparse_bodies(scene, sampled(scene)[1])]
    assert bool(warnings) == warned
    if warned:
        assert warnings[0].startswith(f"scene: bodies.right.particles_per_cell: {per_cell:.3g} particles in a cell")


def volume_warnings(**body: Any) -> list[str]:
    scene = two_balls(**{"particles_per_cell": None, "spacing": 0.01, **body})
    return [str(p) for p in check.volume_errors(scene, *sampled(scene))]


def test_particles_with_another_volume_than_their_shape_are_a_warning() -> None:
    thin = {"box": {"corner": [0.5, 0.45], "size": [0.2, 0.025]}}  # 20 x 3 particles
    (message,) = volume_warnings(shape=thin)
    assert (
        "bodies.right.shape: its particles have a volume of 0.006 m^2, which differs by +20.0% from the 0.005"
        in message
    )
    assert "0.025 m along y is not a multiple of the spacing of 0.01 m; give a size that is one, a spacing" in message
    assert "0.0125 m" in message  # of which 0.2 and 0.025 m are multiples
    (message,) = volume_warnings(shape=thin, spacing=None, particles_per_cell=4)
    assert "give a size that is one, a dx of 0.025 m, or" in message
    odd = {"box": {"corner": [0.5, 0.45], "size": [0.2, 0.02718]}}
    assert "give a size that is one, another spacing, or" in volume_warnings(shape=odd)[0]
    small = {"corner": [0, 0], "size": [0.4, 0.05]}
    assert "+20.0%" in volume_warnings(shape={"box": small}, place={"scale": 0.5, "offset": [0.5, 0.45]})[0]
    assert volume_warnings(shape=thin, unit_mass=True) == []
    for sampling in ({"random": {"count": 60}}, {"lattice": {"count": 9}}):
        assert volume_warnings(shape=thin, spacing=None, sampling=sampling) == []
    assert volume_warnings(shape=thin, sampling={"poisson_disk": {}}) == []
    assert volume_warnings(shape={"box": {"corner": [0.5, 0.45], "size": [0.2, 0.03]}}) == []


def test_size_in_single_precision_counts_as_a_multiple(tmp_path: Path) -> None:
    """An STL file has a side of 0.2 m as 0.2 (1 + 1e-8): the reason is the round shape, and not this side."""
    trimesh.creation.icosphere(3, 0.1).export(tmp_path / "ball.stl")
    mesh = {"mesh": {"file": str(tmp_path / "ball.stl"), "offset": [0.5, 0.5, 0.5]}}
    material = {"density": 1.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0, "poissons_ratio": 0.3}}}
    scene = load_scene({
        "cqrun": 1,
        "world": {"size": [1, 1, 1], "dx": 0.025, "frame": "updated"},
        "bodies": {"ball": {"shape": mesh, "particles_per_cell": 8, "material": material}},
        "time": {"duration": 1.0, "control_step": 0.1},
    })  # fmt: skip
    (message,) = (str(p) for p in check.volume_errors(scene, *sampled(scene)))
    assert "so does its mass: give a smaller spacing, or" in message


def test_unavoidable_volume_errors_of_small_round_bodies_are_no_warning(rng: np.random.Generator) -> None:
    rows = rng.uniform(2, 20, 100)
    ball = {"ball": {"center": [0.6, 0.5], "radius": 0.1}}
    assert sum(bool(volume_warnings(shape=ball, spacing=0.1 / n)) for n in rows) <= 2
    sharp = {"polygon": {"points": [[0.5, 0.45], [0.7, 0.45], [0.7, 0.474], [0.501, 0.474]]}}
    assert "and so does its mass" in volume_warnings(shape=sharp)[0]  # not round: two rows for 2.4


@pytest.mark.parametrize(
    ("dx", "boundary", "warned"),
    [
        (0.03, {"face": "x_max"}, [0]),
        (0.03, {"face": "all"}, [0, 1]),
        (0.03, {"face": "x_min"}, []),
        (0.03, {"face": "x_max", "thickness": 0.03}, []),
        (0.1 / 3, {"face": "all"}, []),
    ],
)
def test_walls_outside_the_world_are_a_warning(dx: float, boundary: dict[str, Any], warned: list[int]) -> None:
    data = two_balls().model_dump(exclude_none=True)
    data["world"]["dx"], data["boundaries"] = dx, {"wall": {"sticky": boundary}}
    messages = [str(p) for p in check.walls_outside(load_scene(data))]
    assert [re.sub(r"scene: world\.size\.(\d): .*", r"\1", message) for message in messages] == list(map(str, warned))
    for message in messages:
        assert "is not a multiple of dx = 0.03 m, so the wall 'wall' begins at 1.02 m, 0.02 m outside" in message
        assert message.endswith("give dx = 0.030303 m, or a size of 0.99 m")


@pytest.mark.parametrize(
    ("plane", "named", "words"),
    [
        ({"point": [0, 0.199], "normal": [0, 1]}, False, "y = 0.199 m .* begin at 0.18 m, 0.019 m .* 0.18 or 0.21 m"),
        ({"point": [0.95, 0], "normal": [-2, 0]}, False, "x = 0.95 m .* begin at 0.96 m, 0.01 m .* 0.96 or 0.93 m"),
        ({"point": [0, 0.01], "normal": [0, 1]}, True, "y = 0.01 m .* begin at 0 m, 0.01 m .* 0 or 0.03 m"),
        ({"point": [0, 0.21], "normal": [0, 1]}, False, None),
        ({"point": [0.93, 0], "normal": [-1, 0]}, True, None),
        ({"point": [0, 0.199], "normal": [0.6, 0.8]}, False, None),  # a slope cannot lie on rows of nodes
    ],
)
def test_planes_between_nodes_are_a_warning(plane: dict[str, Any], named: bool, words: str | None) -> None:
    data = two_balls().model_dump(exclude_none=True)
    ground: Any = {"half_space": plane}
    data["world"]["dx"], data["regions"] = 0.03, {"ground": ground}
    data["boundaries"] = {"floor": {"slip": {"region": "ground" if named else ground}}}
    messages = [str(p) for p in check.planes_between_nodes(load_scene(data))]
    assert len(messages) == (words is not None)
    for message in messages:
        assert re.fullmatch(rf"scene: boundaries\.floor\.slip\.region: its plane at {words}, or give a dx .*", message)


class Pull(Plugin):
    """A load for this test only."""

    kind: ClassVar[str] = "load"
    name: ClassVar[str] = "pull"
    body: BodyName | None = None
    region: ChosenShape


def test_the_error_names_a_load_region_without_particles(monkeypatch: pytest.MonkeyPatch) -> None:
    real = registry.plugins
    monkeypatch.setattr(registry, "plugins", lambda kind: {"pull": Pull} if kind == "load" else real(kind))
    away = {"ball": {"center": [0.9, 0.9], "radius": 0.01}}
    scene = with_values(two_balls(), {"loads.up": {"pull": {"body": "left", "region": away}}})
    (message,) = problems(scene)
    assert message.startswith("scene: loads.up.pull.region: holds no particle: 'left' lies within (0.205,")
    assert problems(with_values(scene, {"loads.up.pull.region.ball.center": [0.3, 0.5]})) == []
    # without a body, particles of any body count
    anywhere = with_values(scene, {"loads.up.pull": {"region": away}})
    assert "'left' lies within" in problems(anywhere)[0]
    assert "'right' lies within" in problems(anywhere)[0]
    assert problems(with_values(anywhere, {"loads.up.pull.region.ball.center": [0.6, 0.5]})) == []
    with pytest.raises(SceneError) as info:
        with_values(scene, {"loads.up.pull.body": "lft"})
    expected = "loads.up.pull.body: there is no body 'lft' (did you mean 'left'?); there are: left, right"
    assert expected in str(info.value)
