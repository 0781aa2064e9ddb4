"""A cantilever let go under gravity: its first frequency and its mean deflection, against a Timoshenko beam."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import history, lattice, swing
from little_worlds import Wall, below, needs_jit, world

from cqrun.boundaries.sticky import Sticky

pytestmark = needs_jit

LENGTH, H, E, RHO = 10.0, 1.0, 1.0, 1.0
SAG = 0.02 * LENGTH
"""What a thin beam would sag at rest [m]."""


def cantilever(dim: int, dx: float, nu: float, periods: float = 1.5) -> tuple[float, float]:
    """Return the relative errors of the frequency and of the deflection at the tip's particles.

    A swing without damping is about the deflection at rest, rho g A L^4 / 8 E I. Shear adds 4 E I / (k G A L^2) to it,
    and takes 5.01 E I / (2 k G A L^2) off the frequency (Dunkerley), k = 5/6; together 0.8 and 0.5 % at nu 0.
    """
    inertia = H**2 / 12  # I / A
    bending, shear = E / (1 - nu**2 if dim == 2 else 1), 5 / 6 * E / (2 * (1 + nu))
    omega = 1.8751041**2 * np.sqrt(bending * inertia / RHO) / LENGTH**2
    g = SAG * 8 * bending * inertia / (RHO * LENGTH**4)
    corner, size = ([0.0, 3.0], [LENGTH, H]) if dim == 2 else ([0.0, 2.0, 3.0], [LENGTH, H, H])
    x, volume = lattice(corner, size, dx / 2), (dx / 2) ** dim
    dt = 0.5 * dx / np.sqrt(E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / RHO)
    substeps = int(2 * np.pi / omega * periods / 200 / dt)
    model, inputs = world(
        x, size=[LENGTH + 2, 6.0] if dim == 2 else [LENGTH + 2, 5.0, 6.0], dx=dx, dt=dt, substeps=substeps,
        controls=int(2 * np.pi / omega * periods / (substeps * dt)), mass=RHO * volume, volume=volume, E=E, nu=nu,
        gravity=[0.0] * (dim - 1) + [-g], walls=[Wall(Sticky, (0.0,) * dim, below(0, 0.0))],
    )  # fmt: skip
    tip = x[:, 0] > LENGTH - 0.6 * dx
    time, height = history(model, inputs, lambda s: (s.x[tip, -1] - x[tip, -1]).mean())
    found, _, mean = swing(time, height, omega)
    at = x[tip, 0].mean()
    sag = RHO * g * at**2 * (6 * LENGTH**2 - 4 * LENGTH * at + at**2) / (24 * bending * inertia)
    soft = bending * inertia / (shear * LENGTH**2)
    return found / (omega * (1 - 5.01 / 2 * soft)) - 1, -mean / (sag * (1 + 4 * soft)) - 1


def test_it_converges_with_the_cell():
    """2, 4 and 8 cells through the thickness, nu 0: -4.2, -1.5, -.5 % of the frequency, 10, 4.2, 2.4 % of the sag."""
    frequency, sag = np.abs(np.array([cantilever(2, dx, 0.0) for dx in (0.5, 0.25, 0.125)])).T
    assert frequency[-1] < 0.01
    assert sag[-1] < 0.035
    assert np.all(frequency[:-1] / frequency[1:] > 2)
    assert np.all(sag[:-1] / sag[1:] > 1.5)


def test_a_thin_beam_sags_too_far():
    """1 and 3 cells through the thickness: 32 and 6 % of the sag, as the warning before a run says."""
    sag = [cantilever(2, dx, 0.0)[1] for dx in (1.0, 1 / 3)]
    assert sag == pytest.approx([0.32, 0.06], abs=0.02)


def test_plane_strain_is_stiffer():
    """nu .3 in 2D bends with E / (1 - nu^2): without it the frequency were 4.6 % and the sag 9 % off."""
    frequency, sag = cantilever(2, 0.25, 0.3)
    assert abs(frequency) < 0.025
    assert abs(sag) < 0.055


@pytest.mark.slow
def test_in_three_dimensions():
    """A square bar, 4 cells thick, nu .3: bends with E itself."""
    frequency, sag = cantilever(3, 0.25, 0.3)
    assert abs(frequency) < 0.025
    assert abs(sag) < 0.055
