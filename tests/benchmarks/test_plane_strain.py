"""A 2D world is a slice of a 3D one between slipping walls."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import final, lattice
from little_worlds import Wall, above, below, world

from cqrun.boundaries.separate import Separate
from cqrun.boundaries.slip import Slip

DX = 0.1


@pytest.mark.parametrize("layers", [2, 4])
def test_a_slab_between_slipping_walls_moves_as_the_plane_does(layers, rng):
    """A body of elastic, viscous, nearly incompressible muscle falls on a floor: the same to round-off.

    The slab is 1 or 2 cells thick: then no node within it is free to leave its plane. Axis y is across it.
    """
    x = lattice([0.3, 0.25], [0.3, 0.3], DX / 2)
    x = x + 0.004 * rng.normal(size=x.shape)
    n, thick = len(x), layers * DX / 2
    levels = (np.arange(layers) + 0.5) * DX / 2
    solid = np.stack([np.tile(x[:, 0], layers), np.repeat(levels, n), np.tile(x[:, 1], layers)], 1)
    body = {
        "E": rng.uniform(8, 12, n), "nu": rng.uniform(0.2, 0.4, n), "neo_hookean": rng.uniform(1, 2, n),
        "eta": rng.uniform(0.01, 0.02, n), "zeta": rng.uniform(0.01, 0.02, n),
        "incompressible": rng.uniform(1, 2, n), "damping": rng.random(n),
    }  # fmt: skip
    run = {"dx": DX, "dt": 4e-3, "substeps": 10, "controls": 5, "activation": np.ones((5, 1))}
    half = np.arange(n) % 2 == 0
    flat_model, flat = world(
        x, size=[1.0, 1.0], mass=0.05**2, volume=0.05**2, gravity=[1.0, -2.0],
        walls=[Wall(Separate, (0, 1), below(1, 0.2))], muscles=((np.flatnonzero(half), np.diag([0.0, 1.0])),),
        **run, **body,
    )  # fmt: skip
    walls = [
        Wall(Separate, (0, 0, 1), below(2, 0.2)), Wall(Slip, (0, 1, 0), below(1, 0.0)),
        Wall(Slip, (0, -1, 0), above(1, thick)),
    ]  # fmt: skip
    solid_model, inputs = world(
        solid, size=[1.0, thick, 1.0], mass=0.05**3, volume=0.05**3, gravity=[1.0, 0.0, -2.0], walls=walls,
        muscles=((np.flatnonzero(np.tile(half, layers)), np.diag([0.0, 0.0, 1.0])),),
        **run, **{name: np.tile(value, layers) for name, value in body.items()},
    )  # fmt: skip
    flat.state.v[:], flat.state.C[:] = 0.3 * rng.normal(size=x.shape) - [0, 1], rng.normal(size=(n, 2, 2))
    plane = np.ix_(np.arange(n * layers), [0, 2], [0, 2])
    inputs.state.v[:, [0, 2]] = np.tile(flat.state.v, (layers, 1))
    inputs.state.C[plane] = np.tile(flat.state.C, (layers, 1, 1))
    want, got = final(flat_model, flat), final(solid_model, inputs)
    assert np.abs(want.F - np.eye(2)).max() > 0.1
    for a, b in ((got.x[:, [0, 2]], want.x), (got.v[:, [0, 2]], want.v), (got.F[plane], want.F)):
        np.testing.assert_allclose(a, np.tile(b, (layers,) + (1,) * (b.ndim - 1)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(got.x[:, 1], solid[:, 1], rtol=0, atol=1e-14)
