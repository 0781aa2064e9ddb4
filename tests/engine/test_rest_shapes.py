"""Equilibria of bodies whose shape is unknown: gradients by rest positions, and paths from another shape."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from test_statics import CASES, DX, cantilever, loss_of

from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.path import RestPath


@pytest.mark.parametrize(("dim", "averaged", "slit"), CASES.values(), ids=CASES)
def test_the_gradient_by_rest_positions_is_that_of_differences(dim, averaged, slit, rng):
    model, inputs = cantilever(dim, uneven=0.02, slit=slit)
    model, inputs.shaped = replace(model, averaged=averaged), True
    equilibrium = Equilibrium(model, inputs)
    rest = equilibrium.solve(tolerance=1e-12)
    _, bar = loss_of(equilibrium, rest.u)
    gradient, _ = equilibrium.gradient(rest.u, record_bar=bar, tolerance=1e-13)
    change, losses = 0.3 * DX * rng.normal(size=inputs.state.x.shape), []
    for k in (-2, -1, 1, 2):
        there = copy.deepcopy(inputs)
        there.state.x += k * 1e-5 * change  # larger steps reach kinks of the ghost penalty and of hats
        moved = Equilibrium(model, there)
        losses.append(loss_of(moved, moved.solve(rest.u, tolerance=1e-13).u)[0])
    difference = (losses[0] - 8 * losses[1] + 8 * losses[2] - losses[3]) / 12e-5
    assert abs(difference) > 0
    assert (gradient.state.x * change).sum() == pytest.approx(difference, rel=1e-7)


def test_a_path_starts_from_the_equilibria_of_another_shape():
    """A cell higher the nodes have other numbers, but the displacements are the same."""
    model, inputs = cantilever(2)
    before = RestPath(model, [inputs], tolerance=1e-8)
    found = before.run().found
    higher = copy.deepcopy(inputs)
    higher.state.x[:, 1] += DX
    higher.state.x[-4:, 0] += 0.8 * DX  # and its end reaches nodes that it did not reach before
    path = RestPath(model, [higher], tolerance=1e-8, near=found)
    here = path.equilibrium(higher)
    assert here.n_nodes > len(found[0].u)
    u = path._near(0, here)
    assert u[here.run.nodes.active].any(axis=1).sum() >= np.count_nonzero(found[0].u.any(axis=1))
    alone = RestPath(model, [higher], tolerance=1e-8)
    with np.errstate(all="ignore"):
        path.run()
        alone.run()
    assert path.points[0].rest.converged
    assert path.points[0].products < alone.points[0].products
    np.testing.assert_allclose(path.points[0].rest.u, alone.points[0].rest.u, rtol=0, atol=1e-6)
