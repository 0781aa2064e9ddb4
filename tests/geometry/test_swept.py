"""Sweeps: discs along curves, against cones, balls and a torus, and the messages about what is no curve."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from cqrun.build.assembly import Assembly
from cqrun.build.model import build
from cqrun.build.particles import sample
from cqrun.errors import SceneError
from cqrun.geometry.cone import Cone
from cqrun.geometry.lattice import Lattice
from cqrun.geometry.sweep import Sweep
from cqrun.plugin.registry import plugins
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaves, shapes_a_body


def sweep(points: Any, radii: Any, curve: str = "smooth") -> Sweep:
    return Sweep.model_validate({"points": points, "radii": radii, "curve": curve})


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("curve", ["smooth", "straight"])
def test_a_sweep_between_two_points_is_a_cone(dim: int, curve: str, rng: np.random.Generator) -> None:
    start, end = [0.1, 0.2, 0.3][:dim], [1.1, 0.7, 0.1][:dim]
    body, cone = sweep([start, end], [0.3, 0.1], curve), Cone(start=start, end=end, start_radius=0.3, end_radius=0.1)
    x = rng.uniform(-0.5, 1.5, (20_000, dim))
    assert (body.inside(x) == cone.inside(x)).all()
    assert np.array(body.bounds()) == pytest.approx(np.array(cone.bounds()), abs=1e-12)
    assert body.volume() == pytest.approx(cone.volume(), rel=2e-3)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_smooth_sweep_through_points_of_an_arc_is_a_bent_rod(dim: int, rng: np.random.Generator) -> None:
    """Through 13 points of a quarter circle, it is a part of a ring or torus to 1/500 of its radius."""
    angle = np.linspace(0, np.pi / 2, 13)
    arc = np.stack([np.cos(angle), np.sin(angle), np.zeros(13)], axis=1)[:, :dim]
    body = sweep(arc.tolist(), [0.2])
    x = rng.uniform(-0.3, 1.3, (40_000, dim))
    across = np.hypot(np.hypot(x[:, 0], x[:, 1]) - 1.0, x[:, 2] if dim == 3 else 0.0)
    ahead = (x[:, :2] >= 0).all(axis=1)
    expected, clear = (across <= 0.2) & ahead, (np.abs(across - 0.2) > 4e-4) & (np.abs(x[:, :2]) > 2.5e-3).all(axis=1)
    assert (body.inside(x) == expected)[clear].all()
    exact = np.pi / 2 * (0.4 if dim == 2 else np.pi * 0.04)
    assert body.volume() == pytest.approx(exact, rel=4e-3)  # as far as a count is


def test_a_smooth_curve_passes_through_its_points_and_does_not_bulge() -> None:
    """The radius changes smoothly, but never leaves the radii of the two points around it."""
    points, radii = [[0, 0, 0], [1, 0, 0], [2, 1, 0], [2, 2, 1]], [0.2, 0.2, 0.05, 0.05]
    line = sweep(points, radii)._line()
    for point, radius in zip(points, radii, strict=True):
        k = int(np.linalg.norm(line.x - point, axis=1).argmin())
        assert line.x[k] == pytest.approx(point, abs=1e-12)
        assert line.radius[k] == pytest.approx(radius)
    assert line.radius.max() <= 0.2
    assert line.radius.min() >= 0.05
    turns = [a @ b / np.linalg.norm(a) / np.linalg.norm(b) for a, b in itertools.pairwise(np.diff(line.x, axis=0))]
    assert min(turns) > np.cos(np.radians(8))


def test_a_straight_curve_has_round_joints() -> None:
    chain = sweep([[0, 0], [1, 0], [1, 1]], [0.2], "straight")
    joint, corner = [1 + 0.19 * 0.5**0.5, -0.19 * 0.5**0.5], [1.15, -0.15]
    assert chain.inside(np.array([joint, corner, [-0.01, 0], [0.5, 0.19], [0.5, 0.21]])).tolist() == [
        True, False, False, True, False,
    ]  # fmt: skip


def test_a_hollow_finger_is_a_difference_of_two_sweeps() -> None:
    curve = [[0, 0, 0], [0, 0, 0.05], [0.02, 0, 0.1]]
    outer, inner = ({"sweep": {"points": curve, "radii": [r, r, 0.8 * r]}} for r in (0.01, 0.007))
    plug = {"half_space": {"point": [0, 0, 0.005], "normal": [0, 0, 1]}}
    cavity = {"difference": [inner, plug]}
    finger = plugins("shape")["difference"].model_validate({"shapes": [outer, cavity]})
    assert finger.inside(np.array([[0, 0, 0.003], [0, 0, 0.05], [0.0085, 0, 0.05]])).tolist() == [True, False, True]


def test_a_tentacle_that_winds_is_filled() -> None:
    points = [[0.02 * np.cos(k), 0.02 * np.sin(k), 0.03 * k] for k in range(10)]
    body = sweep(points, list(np.linspace(0.014, 0.003, 10)))
    x, volume = Lattice(fitted=True).sample(body, 0.0015)
    assert len(x) > 20_000
    assert body.inside(x).all()
    assert volume.sum() == pytest.approx(body.volume(), rel=2e-3)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"points": [[0, 0]], "radii": [1.0]}, "points"),
        ({"points": [[0, 0], [0, 0]], "radii": [1.0]}, "must differ from the point before it"),
        ({"points": [[0, 0], [1, 0, 0]], "radii": [1.0]}, "must have as many entries as the first point"),
        ({"points": [[0, 0], [1, 0]], "radii": [1.0, 0.0]}, "radii"),
        (
            {"points": [[0, 0], [1, 0]], "radii": [1.0, 2.0, 3.0]},
            "must be one for all, or one for each of the 2 points; there are 3",
        ),
    ],
)
def test_what_is_no_curve_is_an_error(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Sweep.model_validate(fields)


def test_its_points_have_as_many_entries_as_the_world() -> None:
    assert sweep([[0, 0], [1, 0]], [0.1]).dim_problems(3)[0] == (
        ("points", 0),
        "must have 3 entries in this 3D world, has 2",
    )


def test_its_numbers_are_no_unknowns_but_its_place_is() -> None:
    material = {"density": 900.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0e4, "poissons_ratio": 0.3}}}
    shape = {"transformed": {"shape": {"sweep": {"points": [[0, 0], [0.1, 0.05]], "radii": [0.02]}}, "angle": 10}}
    body = {"shape": shape, "place": {"offset": [0.1, 0.1]}, "spacing": 0.005, "material": material}
    scene = load_scene({
        "cqrun": 1, "world": {"size": [0.3, 0.3], "dx": 0.01}, "bodies": {"a": body},
        "time": {"duration": 0.01, "control_step": 0.01},
    })  # fmt: skip
    paths = [path for path in leaves(scene, differentiable=True) if shapes_a_body(path)]
    assert "bodies.a.shape.transformed.angle" in paths
    assert not [path for path in paths if ".sweep." in path]
    assert len(Assembly(scene, sample(scene)).inputs({}).state.x) > 100


def test_bodies_of_the_reference_frame_cannot_touch_it() -> None:
    material = {"density": 900.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0e4, "poissons_ratio": 0.3}}}
    body = {"shape": {"box": {"corner": [0.1, 0.2], "size": [0.05, 0.05]}}, "spacing": 0.005, "material": material}
    region = {"sweep": {"points": [[0.1, 0.1], [0.2, 0.1]], "radii": [0.02]}}
    with pytest.raises(SceneError) as info:
        build(load_scene({
            "cqrun": 1, "world": {"size": [0.3, 0.3], "dx": 0.01, "frame": "reference"}, "bodies": {"a": body},
            "boundaries": {"rail": {"friction": {"region": region, "coefficient": 0.3, "normal": [0, 1]}}},
            "time": {"duration": 0.01, "control_step": 0.01},
        }))  # fmt: skip
    (problem,) = info.value.problems
    assert problem.path == "boundaries.rail.friction.region"
    assert problem.message.startswith(
        "the distance from the surface of 'sweep' is not known, so bodies of the reference "
    )
