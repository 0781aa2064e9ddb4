"""A column under its own weight, damped until it rests."""

from __future__ import annotations

import numpy as np
from bodies import final, lattice
from little_worlds import Wall, above, below, needs_jit, world

from cqrun.boundaries.slip import Slip
from cqrun.boundaries.sticky import Sticky

pytestmark = needs_jit

HEIGHT, E, NU, RHO, G = 4.0, 100.0, 0.3, 1.0, 0.5
MODULUS = E * (1 - NU) / ((1 + NU) * (1 - 2 * NU))


def errors(dx: float) -> tuple[float, float]:
    """Return the largest error of the stress at mid-height over rho g h, and the relative one of the top's sinking.

    Between slipping walls the strain is uniaxial, where fixed corotated has P_yy = (lam + 2 mu) (F_yy - 1), so
    P_yy = -rho g (h - y) and the top sinks by rho g h^2 / 2 (lam + 2 mu).
    """
    x, volume = lattice([1.0, 0.0], [1.0, HEIGHT], dx / 2), (dx / 2) ** 2
    c, omega = np.sqrt(MODULUS / RHO), np.pi / 2 / HEIGHT * np.sqrt(MODULUS / RHO)
    dt = 0.4 * dx / c
    walls = [
        Wall(Sticky, (0, 0), below(1, 0.0)), Wall(Slip, (1, 0), below(0, 1.0)), Wall(Slip, (-1, 0), above(0, 2.0))
    ]  # fmt: skip
    model, inputs = world(
        x, size=[3.0, HEIGHT + 1], dx=dx, dt=dt, substeps=int(30 / omega / dt), controls=1, mass=RHO * volume,
        volume=volume, E=E, nu=NU, damping=2 * omega, gravity=[0.0, -G], walls=walls,
    )  # fmt: skip
    last, y = final(model, inputs), x[:, 1]
    assert np.abs(last.v).max() < 1e-6
    stress = MODULUS * (last.F[:, 1, 1] - 1)
    middle = (y > HEIGHT / 4) & (y < 3 * HEIGHT / 4)
    off = np.abs(stress + RHO * G * (HEIGHT - y))[middle].max() / (RHO * G * HEIGHT)
    top = int(y.argmax())
    sinking = RHO * G * (HEIGHT * y[top] - y[top] ** 2 / 2) / MODULUS
    return float(off), float((y[top] - last.x[top, 1]) / sinking - 1)


def test_its_stress_is_the_weight_above():
    """Both errors are of first order in dx: 1.7, .63, .33 % of rho g h, and 4.2, 2.1, 1.1 % of the sinking."""
    stress, sinking = np.array([errors(dx) for dx in (0.5, 0.25, 0.125)]).T
    assert stress[-1] < 0.005
    assert abs(sinking[-1]) < 0.015
    assert np.all(np.log2(stress[:-1] / stress[1:]) > 0.8)
    orders = np.log2(sinking[:-1] / sinking[1:])
    assert np.all((orders > 0.85) & (orders < 1.3)), sinking
