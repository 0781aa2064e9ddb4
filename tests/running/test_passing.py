"""Matter that is where it cannot be: inside another body, itself, an obstacle, or out of the world."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from cqrun.build.model import Built, build
from cqrun.running.passing import Passing
from cqrun.scene.load import load_scene
from cqrun.state import State

MATERIAL = {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}}}


def built(shapes: dict[str, Any], actuators: dict[str, Any] | None = None, **boundaries: Any) -> Built:
    """Return a scene with bodies that have these shapes."""
    bodies = {name: {"shape": shape, "particles_per_cell": 4, "material": MATERIAL} for name, shape in shapes.items()}
    world = {"size": [0.3, 0.2], "dx": 0.01}
    time = {"duration": 0.1, "control_step": 0.02}
    boundaries = boundaries or {"roof": {"separate": {"face": "y_max"}}}
    scene = {"cqrun": 1, "world": world, "bodies": bodies, "boundaries": boundaries, "time": time}
    return build(load_scene(scene | ({"actuators": actuators} if actuators else {})))


def box(x: float, y: float, width: float, height: float) -> dict[str, Any]:
    return {"box": {"corner": [x, y], "size": [width, height]}}


def seen(scene: Built, moved: dict[str, Any] | np.ndarray, F: np.ndarray | None = None) -> list[str]:
    """Return the findings when bodies are moved by a vector, or all particles are elsewhere."""
    state, passing = State.at_rest(scene.particles.x.copy()), Passing(scene)
    if isinstance(moved, dict):
        for name, by in moved.items():
            state.x[scene.particles.of(name)] += by
    else:
        state = replace(state, x=moved)
    if F is not None:
        state.F[:] = F
    passing.look("t = 0.5 s", state)
    return list(passing.findings())


TWO = {"a": box(0.05, 0.05, 0.06, 0.04), "b": box(0.15, 0.05, 0.06, 0.04)}


@pytest.mark.parametrize(("gap", "told"), [(0.02, False), (0.0, False), (-0.001, False), (-0.02, True)])
def test_two_bodies_in_one_place(gap: float, told: bool) -> None:
    found = seen(built(TWO), {"a": [0.04 - gap, 0.0013]})
    assert bool(found) == told
    if told:
        assert found[0].startswith("'a' and 'b' are in the same place from t = 0.5 s (")
        assert "use `world.frame: updated`" in found[0]


U_SHAPE = {"union": [box(0.05, 0.05, 0.02, 0.1), box(0.06, 0.05, 0.1, 0.03), box(0.06, 0.12, 0.1, 0.03)]}


@pytest.mark.parametrize(("fall", "told"), [(0.0, False), (0.03, False), (0.05, True)])
def test_two_arms_of_a_body_in_one_place(fall: float, told: bool) -> None:
    scene = built({"u": U_SHAPE})
    x = scene.particles.x.copy()
    x[(x[:, 0] > 0.07) & (x[:, 1] > 0.1), 1] -= fall  # the upper arm, 4 cells above the lower one
    found = seen(scene, x)
    assert bool(found) == told
    if told:
        assert found[0].startswith("parts of 'u' are in the same place from t = 0.5 s (")
        assert "use `world.frame: updated`, or make them two bodies" in found[0]


@pytest.mark.parametrize("stretch", [0.4, 1.0, 3.0])
def test_a_body_that_is_deformed_does_not_meet_itself(stretch: float) -> None:
    scene = built({"a": box(0.05, 0.05, 0.06, 0.04)})
    F, centre = np.diag([stretch, stretch**-0.3]), scene.particles.x.mean(axis=0)
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])
    assert seen(scene, centre + (scene.particles.x - centre) @ (turn @ F).T, turn @ F) == []


def test_a_body_inside_an_obstacle_and_out_of_the_world() -> None:
    scene = built({"a": TWO["a"]}, floor={"friction": {"face": "y_min", "thickness": 0.04, "coefficient": 0.5}})
    assert seen(scene, {"a": [0.0, -0.012]}) == []  # 0.2 cells deep
    (found,) = seen(scene, {"a": [0.0, -0.016]})
    assert found.startswith("'a' is inside the obstacle `floor` from t = 0.5 s (12 particles)")
    (found,) = seen(scene, {"a": [-0.06, 0.0]})
    assert found.startswith("'a' leaves the world at t = 0.5 s (")


def test_each_thing_is_told_once_with_its_first_time() -> None:
    scene, state = built({"a": TWO["a"]}), State.at_rest(built({"a": TWO["a"]}).particles.x - [0.06, 0.0])
    passing = Passing(scene)
    for control in (0, 1, 2):
        passing.at_control(control, state)
    assert [sentence.split(" (")[0] for sentence in passing.findings()] == ["'a' leaves the world at t = 0 s"]


HOLLOW = {"difference": [box(0.05, 0.05, 0.2, 0.1), box(0.07, 0.07, 0.16, 0.06)]}


@pytest.mark.parametrize(("gap", "told"), [(0.02, False), (0.004, False), (0.0, True), (-0.001, True)])
def test_walls_of_a_chamber_that_touch(gap: float, told: bool) -> None:
    """The upper wall sags until its middle is this far from the lower one."""
    scene = built({"a": HOLLOW}, actuators={"air": {"chamber": {"body": "a", "pressure": 1.0}}})
    x = scene.particles.x.copy()
    upper = (x[:, 1] > 0.13) & (np.abs(x[:, 0] - 0.15) < 0.08)
    x[upper, 1] -= (0.06 - gap) * np.sin(np.pi * (x[upper, 0] - 0.07) / 0.16) ** 2
    found = [sentence for sentence in seen(scene, x) if sentence.startswith("walls of 'a' touch at t = 0.5 s")]
    assert bool(found) == told
