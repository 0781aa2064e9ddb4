"""The loss of `gradcheck` for a scene at rest: a function of its equilibria, and not of a motion."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.build.model import build
from cqrun.running.rest_loss import rest_loss
from cqrun.scene.load import load_scene

SCENE = """
cqrun: 1
job: rest
world: {size: [0.1, 0.1], dx: 0.01, gravity: [0, -9.81]}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.05], size: [0.03, 0.02]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {neo_hookean: {youngs_modulus: 2.0e4, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.03, 0.1]}}, rotation: [0.1]}}
"""


def test_its_gradient_is_that_of_the_equilibrium() -> None:
    loss = rest_loss(build(load_scene(SCENE)), 1)
    assert loss.words == "a random function of 1 equilibrium"
    value, gradient = loss.value_and_grad(loss.x)
    assert value == pytest.approx(loss.value(loss.x), rel=1e-12)
    moving = ("youngs_modulus", "poissons_ratio", "density", "rotation.0", "gravity.1")
    d = np.zeros(len(loss.x))
    for k, block in enumerate(loss.params.blocks):
        if block.path.endswith(moving):
            assert gradient[k] != 0.0, block.path
            d[k] = 1.0 + 0.1 * k
        if block.path.endswith(("velocity.0", "spin.0")):
            assert gradient[k] == 0.0, block.path
    h = 1e-3
    ends = [loss.value(loss.x + step * h * d) for step in (-2, -1, 1, 2)]
    slope = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * h)
    assert gradient @ d == pytest.approx(slope, rel=1e-7)
