"""What a report says of the laws of a scene: two bodies may have one law with two sets of numbers."""

from __future__ import annotations

from typing import Any

from cqrun.report.asked import _laws
from cqrun.scene.load import load_scene


def bar(y: float, c10: float, **more: Any) -> dict[str, Any]:
    material = {"density": 1000, "elastic": {"yeoh": {"c10": c10, "poissons_ratio": 0.4}}}
    shape = {"box": {"corner": [0.02, y], "size": [0.12, 0.03]}}
    return {"shape": shape, "particles_per_cell": 4, "material": material} | more


def scene(**bodies: Any) -> Any:
    time = {"duration": 0.1, "control_step": 0.01}
    return load_scene({"cqrun": 1, "world": {"size": [0.2, 0.2], "dx": 0.01}, "bodies": bodies, "time": time})


def test_every_body_and_region_has_its_own_numbers():
    left = {"elastic": {"yeoh": {"c10": 900.0, "poissons_ratio": 0.4}}}
    region = {"groups": {"left": {"box": {"corner": [0, 0], "size": [0.05, 0.1]}}}, "material_of": {"left": left}}
    given = scene(low=bar(0.02, 500.0), high=bar(0.1, 700.0, **region), top=bar(0.15, 500.0))
    first, second, third = _laws(given)
    assert first.startswith("low, top: yeoh: mu 1000 Pa")
    assert second.startswith("high: yeoh: mu 1400 Pa")
    assert third.startswith("high.left: yeoh: mu 1800 Pa")


def test_one_law_needs_no_name():
    (law,) = _laws(scene(low=bar(0.02, 500.0)))
    assert law.startswith("yeoh: mu 1000 Pa")
