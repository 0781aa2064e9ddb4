"""Bodies that start close to each other: in the updated frame they stick, in the reference frame they come apart."""

from __future__ import annotations

import re

import pytest

from cqrun.build.check_gaps import bodies_too_close
from cqrun.build.particles import fill
from cqrun.scene.load import load_scene

DX = 0.02


def warnings(frame: str, gap: float) -> list[str]:
    """Return the warnings about two balls whose surfaces are some cells apart."""
    material = {"density": 1.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0, "poissons_ratio": 0.3}}}
    bodies = {
        name: {
            "shape": {"ball": {"center": [x, 0.5], "radius": 0.1}},
            "particles_per_cell": 4,
            "material": material,
        }
        for name, x in {"left": 0.3, "right": 0.5 + gap * DX}.items()
    }
    world = {"size": [1, 1], "dx": DX, "frame": frame}
    scene = load_scene({"cqrun": 1, "world": world, "bodies": bodies, "time": {"duration": 1.0, "control_step": 0.1}})
    filled = {name: fill(scene, name) for name in scene.bodies}
    points, volumes = ({name: pair[k] for name, pair in filled.items()} for k in (0, 1))
    return [str(problem) for problem in bodies_too_close(scene, points, volumes)]


@pytest.mark.parametrize(("gap", "warned"), [(0.0, True), (1.4, True), (1.6, False)])
def test_the_updated_frame_warns_of_bodies_that_stick(gap: float, warned: bool) -> None:
    found = warnings("updated", gap)
    assert bool(found) == warned
    for message in found:
        told = r"bodies.right.shape: starts [\d.]+ cells from the body 'left': .* leave 0.03 m between them"
        assert re.search(told, message)


@pytest.mark.parametrize(("gap", "warned"), [(0.0, True), (0.5, False), (1.4, False)])
def test_the_reference_frame_warns_of_bodies_that_touch_and_are_not_joined(gap: float, warned: bool) -> None:
    found = warnings("reference", gap)
    assert bool(found) == warned
    for message in found:
        assert "bodies.right.shape: touches the body 'left' from the start, but is not joined to it" in message
        assert "make them `parts` of one body" in message
