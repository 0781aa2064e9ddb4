"""Which particles cannot move, on a grid that is shifted to the face of the clamp."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.build.model import build
from cqrun.fitting.at_rest import clamped_particles
from cqrun.scene.load import load_scene

BEAM = """
cqrun: 1
world: {size: [0.2, 0.2], dx: 0.01, gravity: [0, -9.81]}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.1], size: [0.12, 0.02]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {neo_hookean: {youngs_modulus: 1.0e5, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.05, 0.2]}}}}
time: {duration: 0.1, control_step: 0.1}
"""


@pytest.mark.parametrize("face", [0.05, 0.0499, 0.046])
def test_they_are_half_a_cell_behind_the_face(face):
    built = build(load_scene(BEAM, [f"boundaries.clamp.sticky.region.box.size.0={face}"]))
    x = built.particles.x[:, 0]
    np.testing.assert_array_equal(clamped_particles(built), x < face - 0.005 + 1e-9)
