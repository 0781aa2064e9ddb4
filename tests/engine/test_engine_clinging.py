"""Bodies of particles that start near each other hold on to each other; those that meet later let go again.

Nothing but shared nodes of the grid joins two bodies, and what is between them counts as unstretched where it starts.
A block that starts on the ground is pulled up and swings as on a spring, until it tears. One that starts more than
a cell and a half above it has its particles rest about a cell from the ground's, and leaves at once.
"""

from __future__ import annotations

import pytest

import cqrun

DX = 0.015625
SCENE = f"""\
cqrun: 1
title: a block on ground of particles is pulled up
world: {{size: [0.6, 4], dx: {DX}, gravity: [0, -2], frame: updated}}
bodies:
  block:
    shape: {{box: {{corner: [0.25, 0.1], size: [0.1, 0.1]}}}}
    spacing: 0.005
    material: {{density: 1, elastic: {{neo_hookean: {{youngs_modulus: 10, poissons_ratio: 0.3}}}}}}
  ground:
    shape: {{box: {{corner: [0.1, 0.025], size: [0.4, 0.075]}}}}
    spacing: 0.005
    material: {{density: 1, elastic: {{neo_hookean: {{youngs_modulus: 60, poissons_ratio: 0.3}}}}}}
boundaries:
  walls: {{friction: {{face: all, coefficient: 0.5, thickness: 0.03125}}}}
  base: {{sticky: {{region: {{box: {{corner: [-1, -1], size: [3, 1.032]}}}}}}}}
actuators: {{lift: {{body_force: {{body: block, direction: [0, 1], acceleration: 2}}}}}}
activation: {{signals: {{lift: [0, 1]}}}}
time: {{duration: 1.2, control_step: 0.02, substeps: 20}}
"""


def rise(gap: float, pull: float, duration: float) -> float:
    """Return how far above its start [m] a block is at the end.

    Args:
        gap: cells between it and the ground at the start.
        pull: force upwards, in its weight, beyond what carries it; for the second half of the run.
        duration: of the run [s].
    """
    overrides = [
        f"bodies.block.shape.box.corner.1={0.1 + gap * DX}", f"time.duration={duration}",
        f"actuators.lift.body_force.acceleration={2.0 * (1.0 + pull)}",
    ]  # fmt: skip
    motion = cqrun.load(SCENE, overrides).simulate()
    height = motion.x[:, motion.bodies["block"], 1].mean(axis=1)
    return float(height[-1] - height[0])


@pytest.mark.parametrize("pull", [0.5, 5.0, 20.0])
def test_a_block_that_starts_on_the_ground_holds_on(pull):
    assert rise(0.0, pull, 0.6) < 0.05  # half of its own height


def test_it_tears_in_the_end():
    assert rise(0.0, 40.0, 0.6) > 0.4


@pytest.mark.parametrize("gap", [1.5, 2.0, 4.0])
def test_a_block_that_lands_lets_go(gap):
    assert rise(gap, 0.5, 1.6) > 0.1
