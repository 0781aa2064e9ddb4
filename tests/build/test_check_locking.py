"""Bodies that hardly change their volume: what is said before a run, and what averaged volumes ask of a scene."""

from __future__ import annotations

from typing import Any

import pytest

from cqrun.build.check_locking import locking_bodies
from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.scene.load import load_scene

RATIO = "bodies.block.material.elastic.fixed_corotated.poissons_ratio"


def scene(ratio: float, bound: float | None = None, law: str = "fixed_corotated", **world: Any) -> Any:
    """Return the scene of one block on a grid of two cells across it."""
    spec: dict[str, Any] = {
        "cqrun": 1,
        "world": {"size": [1, 1], "dx": 0.1, **world},
        "bodies": {
            "block": {
                "shape": {"box": {"corner": [0.3, 0.3], "size": [0.4, 0.2]}},
                "particles_per_cell": 4,
                "material": {"density": 1000, "elastic": {law: {"youngs_modulus": 1e4, "poissons_ratio": ratio}}},
            }
        },
        "time": {"duration": 0.1, "control_step": 0.1},
    }
    if bound is not None:
        data = {"synthetic": {"body": "block", "truth": {RATIO: ratio}, "markers": {"a": [0.35, 0.35]}, "every": 1}}
        spec |= {"unknowns": {RATIO: {"bounds": [0.1, bound]}}, "data": data, "job": "sysid"}
    return load_scene(spec)


@pytest.mark.parametrize(("ratio", "bound"), [(0.4999, None), (0.49, None), (0.3, 0.495)])
def test_a_nearly_incompressible_body_is_told_to_average(ratio, bound):
    (message,) = (str(problem) for problem in locking_bodies(scene(ratio, bound)))
    assert f"{RATIO}: {bound or ratio:g} is nearly incompressible" in message
    assert "`world.volume: averaged` mends this" in message
    (message,) = (str(problem) for problem in locking_bodies(scene(ratio, bound, frame="updated")))
    assert "`world: {frame: reference, volume: averaged}` mends this" in message


def test_other_bodies_are_not():
    assert not list(locking_bodies(scene(0.48)))
    assert not list(locking_bodies(scene(0.48, 0.485)))
    assert not list(locking_bodies(scene(0.4999, volume="averaged")))


def test_the_run_says_it():
    assert any("nearly incompressible" in str(problem) for problem in build(scene(0.4999)).warnings)


def test_the_updated_frame_refuses_averaged_volumes():
    with pytest.raises(SceneError, match=r"world\.volume: volumes are averaged in the reference frame alone"):
        build(scene(0.4, volume="averaged", frame="updated"))
