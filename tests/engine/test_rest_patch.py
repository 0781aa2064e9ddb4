"""Patch tests of equilibrium: fields that a grid of splines has exactly leave no force inside, and no ghost energy."""

from __future__ import annotations

import numpy as np
import pytest
from test_shared_nodes import LOW, TOP, square

from cqrun.build.load_path import inputs_of
from cqrun.engine.reference.ghost import THIRD
from cqrun.engine.statics.equilibrium import Equilibrium


@pytest.fixture(scope="module")
def equilibrium():
    """Return the equilibrium of a square of 10 x 10 cells between two boundaries."""
    built = square(low=LOW, top=TOP)
    return Equilibrium(built.model, inputs_of(built, {}))


def test_an_affine_displacement_leaves_no_force_inside(equilibrium):
    """Every particle has the same stress P, and the forces sum_p vol w P d of a node inside cancel."""
    X = equilibrium._places()
    u = np.zeros((equilibrium.n_nodes, 4))
    u[:, :2] = X @ np.array([[0.2, 0.1], [-0.15, 0.05]]).T + [0.01, -0.02]
    net = equilibrium.net(u)
    # two cells from the square's faces, and beyond what the boundaries hold
    inside = (X[:, 0] > 0.075) & (X[:, 0] < 0.125) & (X[:, 1] > 0.075) & (X[:, 1] < 0.125)
    assert inside.sum() >= 16
    assert np.abs(net).max() > 10
    assert np.abs(net[inside]).max() < 1e-12 * np.abs(net).max()


@pytest.mark.parametrize(("power", "vanishes"), [(1, True), (2, True), (3, False)])
def test_the_ghost_penalty_has_no_energy_for_a_linear_or_quadratic_field(equilibrium, power, vanishes):
    """It is the square of third differences."""
    (ghost,) = equilibrium.rollout.ghosts
    x = equilibrium._places()[:, 0] - 0.1
    y = equilibrium._places()[:, 1] - 0.1
    u = np.stack([x**power - y**power, (x + 0.5 * y) ** power], axis=1)
    third = np.einsum("k,rkd->rd", THIRD, u[ghost.run])
    energy = 0.5 * float((ghost.scale[:, None] * third**2).sum())
    size = 0.5 * float(ghost.scale.sum() * np.abs(u).max() ** 2)
    assert (energy < 1e-24 * size) == vanishes
