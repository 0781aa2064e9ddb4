"""Split nodes: which nodes a gap splits, and that its sides then move as if nothing were between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import split_nodes as plain
from little_worlds import TERMS, Wall, below, world
from test_reference_frame import SHEAR

from cqrun.boundaries.sticky import Sticky
from cqrun.engine.frames import make_rollout
from cqrun.engine.lattice import Lattice
from cqrun.engine.model import GroupModel
from cqrun.engine.reference.patches import make_patches
from cqrun.engine.statics.equilibrium import Equilibrium

DX = 0.1
SPACING = DX / 2


def points(dim, counts):
    """Return the points of a lattice (N, D)."""
    axes = [0.525 + SPACING * np.arange(count) for count in counts[:dim]]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, dim)


def comb(dim, gap, teeth=3):
    """Return the points of teeth, 6 wide, on a strip 2 thick; `gap` layers of the lattice miss between teeth."""
    x = points(dim, (teeth * 6 + (teeth - 1) * gap, 16, 6))
    column = np.rint((x[:, 0] - 0.525) / SPACING).astype(int)
    return x[(column % (6 + gap) < 6) | (x[:, 1] < 0.525 + 1.5 * SPACING)]


def little(bodies, **options):
    """Return a model of elastic bodies on lattices, in the reference frame, and its inputs."""
    dim = bodies[0].shape[1]
    model, inputs = world(
        bodies, size=[2.5] * dim, dx=DX, dt=1e-3, substeps=20, controls=4, mass=SPACING**dim, volume=SPACING**dim,
        E=100.0, nu=0.3, **options,
    )  # fmt: skip
    inputs.terms = [[inputs.terms[0][0]]]
    lattice = Lattice(inputs.state.x.copy(), np.full(len(bodies), SPACING))
    groups = (GroupModel(tuple(range(len(bodies))), (TERMS[0],), shear=SHEAR[:1]),)
    return replace(model, frame="reference", groups=groups, lattice=lattice), inputs


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("gap", [0, 1, 2, 4, 5, 6])
def test_gaps_below_three_cells_split_nodes(dim, gap):
    """A stencil reaches 3 cells, and 5 layers that miss are a gap of 3 cells between the particles' own volumes."""
    model, _ = little([comb(dim, gap)])
    patches = make_patches(model.layout, comb(dim, gap), DX, None, model.lattice)
    assert bool(len(patches.split)) == (0 < gap < 5)


@pytest.mark.parametrize("dim", [2, 3])
def test_they_are_those_of_a_slow_search(dim):
    """The same particles share nodes at every place of their stencils, and every node is where its stencil says."""
    x = comb(dim, 2, teeth=2)
    model, _ = little([x])
    patches = make_patches(model.layout, x, DX, None, model.lattice)
    nodes, layers = patches.nodes_of(patches.layout.columns()), plain.layers(model, x)
    base = np.floor(x / DX - 0.5).astype(int)
    for k, (offset, layer) in enumerate(layers.items()):
        np.testing.assert_allclose(patches.positions(DX)[nodes[:, k]], (base + np.array(offset)) * DX, atol=1e-12)
        key = np.column_stack([base + np.array(offset), layer])
        _, want = np.unique(key, axis=0, return_inverse=True)
        _, got = np.unique(nodes[:, k], return_inverse=True)
        assert len(np.unique(np.column_stack([want.ravel(), got]), axis=0)) == want.max() + 1 == got.max() + 1


def test_a_body_that_changes_its_shape_stays_whole():
    """Neighbours are those on the lattice, however far the shape pulls them apart, and a gap stays one."""
    x = comb(2, 2)
    model, _ = little([x])
    for stretch in (1.0, 2.5):
        patches = make_patches(model.layout, x * [stretch, 1.0], DX, None, model.lattice)
        assert bool(len(patches.split)) == (stretch == 1.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_two_halves_with_a_gap_move_as_two_bodies(dim):
    """One body of two pieces half a cell apart, and the same pieces as bodies, of which each has nodes of its own."""
    left = points(dim, (6, 8, 6))
    right = left + np.array([7 * SPACING, *[0.0] * (dim - 1)])
    found = []
    for bodies in ([np.concatenate([left, right])], [left, right]):
        model, inputs = little(bodies)
        half = inputs.state.x[:, 0] > right[:, 0].min() - 1e-9
        inputs.state.v[:, 1] = np.where(half, 1.0, -1.0) * inputs.state.x[:, 0]
        rollout = make_rollout(model, inputs)
        rollout.run()
        found.append(rollout.unpack(rollout.final, 0).x)
    assert np.abs(found[0] - inputs.state.x).max() > 0.05
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-12)


def test_a_narrow_gap_opens_as_a_wide_one_does():
    """A strip with two blocks on it bends in the gap between them, by an angle that grows with the gap's width.

    A gap of one cell is stiffer than in proportion, because its sides share nodes at its end. If they share all nodes,
    it stays shut.
    """
    sag = {}
    for gap, splits in ((2, True), (4, True), (2, False)):
        model, inputs = little(
            [comb(2, gap, teeth=2)], gravity=[0.0, -0.05], walls=[Wall(Sticky, (0.0, 0.0), below(0, 0.7))]
        )
        rest = Equilibrium(model if splits else replace(model, lattice=None), inputs).solve(tolerance=1e-9)
        assert rest.converged
        sag[gap, splits] = np.abs(rest.u[:, 1]).max() / gap
    assert 0.5 < sag[2, True] / sag[4, True] < 1.0
    assert sag[2, False] < 0.3 * sag[2, True]
