"""Clamps whose path leads through something are asked about before the run."""

from __future__ import annotations

from typing import Any

import pytest

from cqrun.build.check_moves import moving_warnings
from cqrun.build.particles import sample
from cqrun.scene.load import load_scene

MATERIAL = {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}}}


def questions(boundaries: dict[str, Any], second: bool = False, over: float | None = None, **move: Any) -> list[str]:
    """Return the questions about a clamp at the left end of a bar; `second` adds a body at x = 0.12 to 0.18 m."""
    corners = {"a": [0.02, 0.08], **({"b": [0.12, 0.08]} if second else {})}
    bodies = {
        name: {"shape": {"box": {"corner": at, "size": [0.06, 0.04]}}, "particles_per_cell": 4, "material": MATERIAL}
        for name, at in corners.items()
    }
    mover = {"region": {"box": {"corner": [0, 0], "size": [0.08, 0.2]}}, **move}
    scene = load_scene(
        {
            "cqrun": 1,
            "world": {"size": [0.3, 0.2], "dx": 0.01},
            "bodies": bodies,
            "boundaries": {"mover": {"sticky": mover if over is None else {**mover, "over": over}}, **boundaries},
            "time": {"duration": 0.1, "control_step": 0.02},
        }
    )
    return [f"{problem.path}: {problem.message}" for problem in moving_warnings(scene, sample(scene))]


WALL = {"wall": {"sticky": {"region": {"box": {"corner": [0.16, 0.0], "size": [0.1, 0.2]}}}}}
FLOOR = {"floor": {"separate": {"face": "y_min", "thickness": 0.05}}}


def test_a_short_way_raises_no_question() -> None:
    assert questions(FLOOR, displacement=[0.02, 0.01]) == []
    assert questions(FLOOR, second=True, displacement=[0.02, 0.01]) == []


def test_a_way_out_of_the_world() -> None:
    (found,) = questions({}, displacement=[0.28, 0.0], over=0.05)
    assert found.startswith("boundaries.mover.sticky: carries 'a' out of the world at t = 0.03")
    # the run ends before it gets there
    assert questions({}, displacement=[0.28, 0.0], over=0.2) == []


def test_a_turn_out_of_the_world() -> None:
    (found,) = questions({}, rotation=[3.14], center=[0.0, 0.1])
    assert "carries 'a' out of the world" in found


def test_a_way_into_an_obstacle() -> None:
    (found,) = questions(FLOOR, displacement=[0.0, -0.05])
    assert found.startswith("boundaries.mover.sticky: carries 'a' into the obstacle `floor` at t = 0.0")


@pytest.mark.parametrize("held", [False, True])
def test_a_way_into_another_body(held: bool) -> None:
    (found,) = questions(WALL if held else {}, second=True, displacement=[0.1, 0.0])
    assert ("carries 'a' to where 'b' is held at t = 0.0" in found) == held
    assert ("so 'b' has to make way: is that meant?" in found) != held
