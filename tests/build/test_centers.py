"""The points about which moments of boundaries are: they do not depend on the grid."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.build.model import build
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.scene.load import load_scene

BEAM = """
cqrun: 1
world: {size: [0.4, 0.3], dx: 0.01, gravity: [0, -9.81]}
bodies:
  beam:
    shape: {box: {corner: [0.02, 0.2], size: [0.2, 0.03]}}
    particles_per_cell: 4
    material: {density: 1000, elastic: {neo_hookean: {youngs_modulus: 5.0e5, poissons_ratio: 0.3}}}
boundaries:
  clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.04, 0.3]}}}}
time: {duration: 1, control_step: 0.01}
"""
CENTER = "boundaries.clamp.sticky.center"


def built_on(dx, *overrides):
    return build(load_scene(BEAM, [f"world.dx={dx}", *overrides]))


def moment(built):
    """Return the moment of the clamp at rest [N]."""
    equilibrium = Equilibrium(built.model, built.assembly.inputs({}))
    return float(equilibrium.held_by(equilibrium.solve().u)["clamp"][1][0])


def test_it_is_the_centre_of_the_material_inside_on_every_grid():
    for dx in (0.01, 0.005):
        np.testing.assert_allclose(built_on(dx).model.centers["clamp"], [0.03, 0.215], rtol=0, atol=1e-12)


def test_the_moment_carries_the_weight_about_it_on_every_grid():
    """The arm of its weight, 58.86 N/m, is 0.12 - 0.03 m, and a little less where the beam sags."""
    found = [moment(built_on(dx)) for dx in (0.01, 0.005)]
    assert found == pytest.approx([58.86 * 0.09] * 2, rel=2e-2)
    assert found[0] == pytest.approx(found[1], rel=2e-3)


def test_a_center_that_is_given_is_that_of_the_moment_too():
    built = built_on(0.01, f"{CENTER}=[0.04, 0.215]")
    np.testing.assert_array_equal(built.model.centers["clamp"], [0.04, 0.215])
    assert moment(built) == pytest.approx(moment(built_on(0.01)) - 58.86 * 0.01, rel=1e-6)


def test_a_clamp_turns_about_its_material():
    """A quarter turn leaves the centre of the held material where it was."""
    built = built_on(0.01, "boundaries.clamp.sticky.rotation=[0.5]", "world.gravity=[0, 0]")
    equilibrium = Equilibrium(built.model, built.assembly.inputs({}))
    rest = equilibrium.solve()
    held = built.particles.x[:, 0] < 0.03
    inside = built.particles.x[:, 0] < 0.04
    x = equilibrium.state(rest.u).x
    assert np.abs(x[held] - built.particles.x[held]).max() > 1e-3
    np.testing.assert_allclose(x[inside].mean(axis=0), [0.03, 0.215], rtol=0, atol=1e-4)


def test_a_plane_on_the_face_of_a_body_has_the_mean_of_its_nodes():
    built = built_on(0.01, "boundaries.wall={slip: {region: {half_space: {point: [0, 0.2], normal: [0, 1]}}}}")
    assert set(built.model.centers) == {"clamp"}
