"""The preconditioner of equilibria knows averaged volumes: they cost no more products near nu = 1/2."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from little_worlds import Wall, below
from test_statics import cantilever

from cqrun.boundaries.slip import Slip
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.krylov import conjugate_gradients


@pytest.mark.parametrize("dim", [2, 3])
def test_products_do_not_grow_as_volume_is_kept(dim):
    """The preconditioner knows averaged volumes, however stiff they are."""
    model, inputs = cantilever(dim)
    products = []
    for nu in (0.45, 0.49, 0.4999):
        inputs.terms[0][0][1, :] = nu
        equilibrium = Equilibrium(replace(model, averaged=True), inputs)
        equilibrium.linearise(np.zeros_like(equilibrium.still))
        b = equilibrium.holding.freed(equilibrium.outside)
        found = conjugate_gradients(equilibrium.product, b, equilibrium.precondition, 1e-8, 2000)
        assert found.converged
        products.append(found.iterations)
    assert products[2] < 1.5 * products[0]


@pytest.mark.parametrize("dim", [2, 3])
def test_the_preconditioner_inverts_blocks_and_volumes_together(dim, rng):
    """D + R^T S R on the free directions, where D are the blocks without volumes; some nodes slip along a slope."""
    slope = tuple(np.array([0.6, 0.8, 0.0])[:dim])
    model, inputs = cantilever(dim, walls=[Wall(Slip, slope, below(1, 0.25))])
    equilibrium = Equilibrium(replace(model, averaged=True), inputs)
    equilibrium.linearise(np.zeros_like(equilibrium.still))
    volumes, active = equilibrium.volumes, equilibrium.run.nodes.active
    z = np.zeros_like(equilibrium.still)
    z[active, :dim] = rng.normal(size=(len(active), dim))
    z = equilibrium.holding.freed(z)
    P = np.tile(np.eye(dim), (len(z), 1, 1))
    P[equilibrium.holding.nodes] = equilibrium.holding.free
    assert any(np.linalg.matrix_rank(free) == dim - 1 for free in equilibrium.holding.free)
    inverse = P[active] @ equilibrium.preconditioner.inverse @ P[active]
    r = np.zeros_like(z)
    r[active, :dim] = np.einsum("nij,nj->ni", np.linalg.pinv(inverse, rcond=1e-10, hermitian=True), z[active, :dim])
    r[:, :dim] += volumes.product(z[:, :dim])
    np.testing.assert_allclose(equilibrium.precondition(equilibrium.holding.freed(r)), z, rtol=0, atol=1e-9)
