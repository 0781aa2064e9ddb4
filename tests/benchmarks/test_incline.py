"""A block on an incline with Coulomb friction: it slides with a = g (sin t - mu cos t), or it stays."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import history, lattice
from little_worlds import Wall, below, needs_jit, world

from cqrun.boundaries.friction import Friction

pytestmark = needs_jit

G, DX, RHO, E, SIDE = 10.0, 0.1, 1000.0, 2e6, 0.4
DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
TILTED = pytest.mark.parametrize("tilted", [False, True], ids=["gravity tilted", "floor tilted"])


def slide(dim: int, tilted: bool, mu: float, angle: float, v0: float, duration: float, damping: float = 0.0):
    """Return times, and the centre's (velocity, displacement) along and across the incline at each.

    Either gravity is tilted and the floor lies along the grid, or the floor is a half-space cut out of the grid.
    """
    up, along, corner = np.eye(dim)[-1], np.eye(dim)[0], np.zeros(dim)
    corner[:] = 0.3
    corner[-1] = 0.2
    x = lattice(list(corner), [SIDE] * dim, DX / 2)
    gravity = G * np.sin(angle) * along - G * np.cos(angle) * up
    floor = below(dim - 1, 0.2)
    if tilted:
        R = np.eye(dim)
        R[0, 0] = R[-1, -1] = np.cos(angle)
        R[0, -1], R[-1, 0] = np.sin(angle), -np.sin(angle)
        x = (x - corner) @ R.T + corner + 0.9 * np.eye(dim)[-1]
        corner[-1] += 0.9
        up, along, gravity = R @ up, R @ along, -G * np.eye(dim)[-1]

        def floor(nodes: np.ndarray) -> np.ndarray:
            return (nodes - corner) @ up <= 1e-9

    dt, volume = 0.4 * DX / np.sqrt(1.35 * E / RHO), (DX / 2) ** dim
    model, inputs = world(
        x, size=[3.0] + [1.0] * (dim - 2) + [2.0], dx=DX, dt=dt, substeps=6, controls=int(duration / (6 * dt)),
        mass=RHO * volume, volume=volume, E=E, nu=0.3, gravity=gravity, damping=damping,
        walls=[Wall(Friction, tuple(up), floor, mu)],
    )  # fmt: skip
    inputs.state.v[:] = v0 * along
    axes, start = np.stack([along, up], 1), x.mean(0)
    return history(model, inputs, lambda s: np.append(s.v.mean(0) @ axes, (s.x.mean(0) - start) @ axes))


@DIM
@TILTED
@pytest.mark.parametrize(("mu", "angle"), [(0.0, 0.5), (0.3, 0.5), (0.2, 0.35)])
def test_it_slides(dim, tilted, mu, angle):
    """The slope of the speed to .3 %, with the block's bouncing in it; the balance of momentum to 2e-5.

    Friction takes mu times the normal momentum that the floor gives: v_t + mu v_n grows by a t, bounces or not.
    """
    time, found = slide(dim, tilted, mu, angle, v0=1.0, duration=0.5)
    expected = G * (np.sin(angle) - mu * np.cos(angle))
    assert np.polyfit(time, found[:, 0], 1)[0] == pytest.approx(expected, rel=3e-3)
    balance = (found[-1, 0] + mu * found[-1, 1] - 1.0) / time[-1]
    assert balance == pytest.approx(expected, rel=2e-5)
    assert np.abs(found[:, 3]).max() < 5e-3


@DIM
@TILTED
@pytest.mark.parametrize(("mu", "angle"), [(1.0, 0.2), (1.0, 0.5)])
def test_it_stays(dim, tilted, mu, angle):
    """mu > tan t: it settles by its own shear and stays, where a free one would have gone 1 to 2.4 m."""
    time, found = slide(dim, tilted, mu, angle, v0=0.0, duration=1.0, damping=3.0)
    later = time > 0.7
    assert np.abs(found[later, 2]).max() < 0.02
    assert np.ptp(found[later, 2]) < 5e-4
    assert abs(found[-1, 0]) < 2e-3


@TILTED
def test_between_them_it_comes_to_rest_where_the_energy_is_spent(tilted):
    """mu > tan t and a push: it stops after v^2 / 2 g (mu cos t - sin t), to 2 %."""
    mu, angle = 0.5, 0.3
    _, found = slide(2, tilted, mu, angle, v0=1.5, duration=1.1)
    way = 1.5**2 / (2 * G * (mu * np.cos(angle) - np.sin(angle)))
    assert found[-1, 2] == pytest.approx(way, rel=0.02)
    assert abs(found[-1, 0]) < 0.02
