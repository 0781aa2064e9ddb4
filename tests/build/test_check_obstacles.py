"""Obstacles of the reference frame that bodies may pass through are a warning before the run."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit

import cqrun
from cqrun.build.check_obstacles import obstacle_warnings
from cqrun.scene.load import load_scene

MATERIAL = {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 1e5, "poissons_ratio": 0.3}}}
DX = 0.02


def scene(region: dict[str, Any], frame: str = "reference") -> dict[str, Any]:
    """Return a ball that falls on a shelf below y = 0.3 m at 1 m/s, in a world of 50 by 50 cells."""
    body = {"shape": {"ball": {"center": [0.5, 0.41], "radius": 0.1}}, "velocity": [0, -1.0], "particles_per_cell": 4}
    shelf = {"friction": {"region": region, "coefficient": 0.3, **({} if frame == "reference" else {"normal": [0, 1]})}}
    return {
        "cqrun": 1,
        "world": {"size": [1, 1], "dx": DX, "frame": frame, "gravity": [0, -9.81]},
        "bodies": {"a": {**body, "material": MATERIAL}},
        "boundaries": {"shelf": shelf},
        "time": {"duration": 0.2, "control_step": 0.02},
    }


def told(region: dict[str, Any], frame: str = "reference") -> list[str]:
    return [str(problem) for problem in obstacle_warnings(load_scene(scene(region, frame)))]


def plate(thickness: float) -> dict[str, Any]:
    return {"box": {"corner": [0.3, 0.3 - thickness], "size": [0.4, thickness]}}


def rod(thickness: float, length: float = 0.4, **fields: Any) -> dict[str, Any]:
    low = 0.3 - thickness / 2
    ends = {"start": [0.5 - length / 2, low], "end": [0.5 + length / 2, low], "radius": thickness / 2}
    return {"capsule": {**ends, **fields}}


MESSAGE = (
    "scene: boundaries.shelf.friction.region: is {} m thick, {} cells: bodies may pass through it; make it {} m thick"
)


@pytest.mark.parametrize(
    ("region", "words"),
    [
        (plate(0.002), ("0.002", "0.1", "0.01")),
        (plate(0.01), None),
        (rod(0.002), ("0.002", "0.1", "0.01")),
        (rod(0.002, end_radius=0.01), None),
        (rod(0.01), None),
        (rod(0.01, length=0.005), ("0.01", "0.5", "0.03")),
        ({"ball": {"center": [0.5, 0.29], "radius": 0.01}}, ("0.02", "1", "0.03")),
        ({"ball": {"center": [0.5, 0.28], "radius": 0.02}}, None),
        ({"cone": {"start": [0.5, 0.296], "end": [0.5, 0.3], "start_radius": 0.2, "end_radius": 0.1}},
         ("0.004", "0.2", "0.01")),
        ({"polygon": {"points": [[0.3, 0.296], [0.7, 0.296], [0.7, 0.3], [0.3, 0.3]]}}, ("0.00396", "0.2", "0.01")),
        ({"polygon": {"points": [[0.3, 0.2], [0.7, 0.2], [0.5, 0.3]]}}, None),
        ({"half_space": {"point": [0, 0.3], "normal": [0, 1]}}, None),
        ({"height_field": {"points": [[0, 0.3], [1, 0.3]]}}, None),
        ({"transformed": {"shape": plate(0.02), "scale": 0.1, "offset": [0.3, 0.27]}}, ("0.002", "0.1", "0.01")),
    ],
)  # fmt: skip
def test_obstacles_that_are_too_thin(region: dict[str, Any], words: tuple[str, str, str] | None) -> None:
    messages = told(region)
    assert [message.partition(", or dx")[0] for message in messages] == (
        [] if words is None else [MESSAGE.format(*words)]
    )


def test_a_thin_plate_on_a_block_is_no_obstacle_of_its_own() -> None:
    block = {"box": {"corner": [0.3, 0.1], "size": [0.4, 0.198]}}
    assert told({"union": [plate(0.002), block]}) == []
    beside = {"box": {"corner": [0.1, 0.1], "size": [0.2, 0.2]}}
    assert len(told({"union": [plate(0.002), beside]})) == 1


def test_the_updated_frame_has_nodes_instead() -> None:
    assert told(plate(0.002), "updated") == []


@needs_jit
@pytest.mark.parametrize(("region", "stops"), [
    (plate(0.002), False), (plate(0.01), True), (rod(0.002), False), (rod(0.01), True),
    ({"ball": {"center": [0.5, 0.29], "radius": 0.01}}, False),
    ({"ball": {"center": [0.5, 0.285], "radius": 0.015}}, True),
])  # fmt: skip
def test_a_body_passes_through_what_is_warned_about(region: dict[str, Any], stops: bool) -> None:
    motion = cqrun.load({**scene(region), "job": "simulate"}).simulate()
    assert (np.asarray(motion.x)[-1, :, 1].min() > 0.25) == stops
    assert (told(region) == []) == stops
