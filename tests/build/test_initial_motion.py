"""A body starts with the motion that its scene gives, and keeps it in the first step."""

from __future__ import annotations

import numpy as np
import pytest
from small_beam import BEAM

import cqrun
from cqrun.build.assembly import Assembly
from cqrun.build.initial_motion import rotations
from cqrun.build.particles import sample
from cqrun.scene.load import load_scene

FREE = [
    "world.gravity=[0, 0]",
    "bodies.beam.shape.box={corner: [0.05, 0.05], size: [0.03, 0.03]}",
    "boundaries.clamp.sticky.region.box.size=[0.01, 0.12]",
]
"""The small beam as a block of three by three cells, far from its clamp."""


@pytest.mark.parametrize("place", [None, "{offset: [0.13, 0], angle: 90}"])
def test_a_free_block_turns_as_fast_as_its_scene_says(place):
    """Without its affine matrices it would turn at 4.5 rad/s after one step, with a fifth of its energy lost."""
    more = [] if place is None else [f"bodies.beam.place={place}"]
    problem = cqrun.load(BEAM, [*FREE, *more, "bodies.beam.spin=[5]", "bodies.beam.velocity=[0.1, 0]"])
    motion = problem.simulate()
    x, v = motion.x - motion.x.mean(axis=1, keepdims=True), motion.v - motion.v.mean(axis=1, keepdims=True)
    inertia, momentum = (x**2).sum(axis=(1, 2)), (x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0]).sum(axis=1)
    assert momentum[0] / inertia[0] == pytest.approx(5.0, rel=1e-12)
    np.testing.assert_allclose(momentum / inertia, 5.0, rtol=1e-3)
    energy = (motion.v**2).sum(axis=(1, 2))
    np.testing.assert_allclose(energy, energy[0], rtol=2e-3)


def test_the_affine_matrix_is_the_gradient_of_the_velocity():
    """In 3D, about all axes at once."""
    box = {"box": {"corner": [0.2] * 3, "size": [0.2, 0.3, 0.4]}}
    material = {"density": 1.0, "elastic": {"neo_hookean": {"youngs_modulus": 1.0, "poissons_ratio": 0.3}}}
    body = {"shape": box, "spacing": 0.05, "material": material, "spin": [1.0, -2.0, 3.0], "velocity": [0.1, 0.2, 0.3]}
    time = {"duration": 0.01, "control_step": 0.01}
    scene = load_scene(
        {"cqrun": 1, "world": {"size": [1.0] * 3, "dx": 0.1, "frame": "updated"}, "bodies": {"a": body}, "time": time}
    )
    start = Assembly(scene, sample(scene)).inputs({}).state
    arms = start.x - start.x.mean(axis=0)
    np.testing.assert_allclose(start.v, np.cross([1.0, -2.0, 3.0], arms) + 0.1 * np.arange(1, 4), rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.einsum("nde,ne->nd", start.C, arms), np.cross([1.0, -2.0, 3.0], arms), atol=1e-15)


@pytest.mark.parametrize("dim", [2, 3])
def test_unit_spins_are_rotations(dim):
    for A in rotations(dim):
        np.testing.assert_array_equal(A, -A.T)
        assert np.abs(A).sum() == 2.0


def test_bodies_without_a_spin_have_no_affine_matrix():
    """Not even a negative zero: results of such scenes stay the same to the bit."""
    scene = load_scene(BEAM, ["bodies.beam.velocity=[0.1, -0.2]"])
    C = Assembly(scene, sample(scene)).inputs({}).state.C
    assert not C.any()
    assert not np.signbit(C).any()
