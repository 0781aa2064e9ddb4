"""A finger of 48 particles that learns to reach: whole control jobs take a second, with the kernels of the finger."""

from __future__ import annotations

from pathlib import Path

FINGER = """\
cqrun: 1
title: a small finger
job: control
world: {size: [1, 1], dx: 0.1, frame: updated}
bodies:
  finger:
    parts:
      left: {box: {corner: [1, 0], size: [0.5, 2]}}
      right: {box: {corner: [1.5, 0], size: [0.5, 2]}}
      tip: {box: {corner: [1, 2], size: [1, 1]}}
    place: {scale: 0.2, offset: [0.2, 0.2]}
    sampling: {lattice: {count: 4}}
    unit_mass: true
    material: {density: 1, elastic: {fixed_corotated: {youngs_modulus: 10, poissons_ratio: 0.3}}}
boundaries:
  walls: {friction: {face: all, coefficient: 0.5}}
  base: {sticky: {region: {box: {corner: [-1, -1], size: [3, 1.31]}}}}
actuators:
  muscle: {muscle: {body: finger, each: [left, right], axis: [0, 1], strength: 4}}
observers:
  parts: {centroids: {body: finger, of: [position, velocity]}}
  goal: {goal: {goal: target}}
  clock: {clock: {}}
controller: {linear_tanh: {}}
goals: {target: {position: [0.6, 0.6], spread: [0.05, 0.05]}}
episodes: {count: 2, unseen: 1}
objective:
  tip: {reach: {body: finger, group: tip, goal: target}}
  effort: {effort: {weight: 1.0e-3}}
time: {duration: 0.1, control_step: 0.01, substeps: 2}
optimizer: {adam: {learning_rate: 0.1, max_iterations: 4}}
"""

STIFFNESS = "bodies.finger.material.elastic.fixed_corotated.youngs_modulus"
DESIGN = (
    FINGER.replace("  tip: {reach: {body: finger, group: tip, goal: target}}\n", "")
    .replace("job: control", "job: codesign")
    .replace("optimizer: {adam: {learning_rate: 0.1, max_iterations: 4}}", "optimizer: {slsqp: {max_iterations: 30}}")
    .replace("effort: {effort: {weight: 1.0e-3}}", "effort: {effort: {}}")
    + f"""\
unknowns:
  {STIFFNESS}: {{bounds: [5, 20], per: particle}}
constraints:
  tip: {{of: {{reach: {{body: finger, group: tip, goal: target}}}}, at_most: 0.018, scale: 0.01}}
  up: {{of: {{height: {{body: finger, group: tip, axis: y}}}}, at_least: 0.3, at_most: 0.9}}
"""
)
"""A design of its stiffness per particle with its controller; the tip must be near its goal, with a small effort."""


def written(folder: Path, text: str = FINGER) -> Path:
    """Return a scene file of the small finger."""
    path = folder / "finger.yaml"
    path.write_text(text)
    return path
