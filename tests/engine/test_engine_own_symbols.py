"""Two laws in one process, and in one scene, each compute as they do alone."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.materials.term import _STRESS
from cqrun.scene.load import load_scene
from cqrun.state import State

SCENE = """
cqrun: 1
world: {{size: [1.2, 0.8], dx: 0.05, frame: updated}}
bodies:
  one: {{shape: {{box: {{corner: [0.2, 0.3], size: [0.2, 0.2]}}}}, particles_per_cell: 4, spin: [12.0],
    material: {{density: 1.0, elastic: {{{one}: {{youngs_modulus: 10, poissons_ratio: 0.3}}}}}}}}
  two: {{shape: {{box: {{corner: [0.8, 0.3], size: [0.2, 0.2]}}}}, particles_per_cell: 4, spin: [12.0],
    material: {{density: 1.0, elastic: {{{two}: {{youngs_modulus: 10, poissons_ratio: 0.3}}}}}}}}
time: {{duration: 0.2, control_step: 0.05, substeps: 20}}
"""


def stretches(one: str, two: str) -> dict[str, np.ndarray]:
    """Return the deformation of both bodies at the end."""
    built = build(load_scene(SCENE.format(one=one, two=two)))
    rollout = make_rollout(built.model, built.assembly.inputs({}))
    rollout.run()
    final = State.unpack(rollout.final, built.model.layout, np.zeros(0))
    return {name: final.F[built.particles.of(name)] for name in ("one", "two")}


def test_classes_that_kernels_see_have_names_of_their_own() -> None:
    # a module that a test has loaded twice registers its class twice, under the same name
    names = {cls.__name__ for cls in _STRESS.bodies}
    assert len(names) == len({(cls.__module__, cls.__qualname__) for cls in _STRESS.bodies}) >= 5


def test_two_laws_side_by_side_are_what_each_is_alone() -> None:
    alone = {law: stretches(law, law) for law in ("fixed_corotated", "neo_hookean")}
    mixed = stretches("fixed_corotated", "neo_hookean")
    differ = np.abs(alone["fixed_corotated"]["two"] - alone["neo_hookean"]["two"]).max()
    assert differ > 1e-3
    assert mixed["one"] == pytest.approx(alone["fixed_corotated"]["one"], abs=1e-12)
    assert mixed["two"] == pytest.approx(alone["neo_hookean"]["two"], abs=1e-12)
