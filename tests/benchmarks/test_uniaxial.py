"""A bar pulled at its end until it rests: its stretches against the laws' own, at finite strain."""

from __future__ import annotations

import numpy as np
import pytest
from bodies import final, lattice
from little_worlds import Wall, below, needs_jit, world
from scipy.optimize import brentq

from cqrun.boundaries.slip import Slip

pytestmark = needs_jit

E, NU, LENGTH, DX = 1.0, 0.3, 4.0, 0.25
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))


def nominal(law: str, stretch: float, others: list[float]) -> float:
    """Return the first Piola stress along a principal axis, from the energies of CQ2 eqs 12 and 13."""
    J = stretch * np.prod(others)
    if law == "E":
        return 2 * MU * (stretch - 1) + LAM * (J - 1) * J / stretch
    return MU * (stretch - 1 / stretch) + LAM * np.log(J) / stretch


def uniaxial(law: str, dim: int, stretch: float) -> tuple[float, float]:
    """Return the lateral stretch at which nothing pulls sideways, and the axial stress there."""

    def others(b: float) -> list[float]:
        return [b, b] if dim == 3 else [b, 1.0]

    lateral = brentq(lambda b: nominal(law, b, [stretch, others(b)[1]]), 0.5, 1.5, xtol=1e-14)
    return lateral, nominal(law, stretch, others(lateral))


@pytest.mark.parametrize("law", ["E", "neo_hookean"], ids=["fixed corotated", "Neo-Hookean"])
@pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
@pytest.mark.parametrize("stretch", [0.8, 1.3])
def test_its_stretches(law, dim, stretch):
    """Axial strain to .3 %, lateral strain to .3 %, in the bar's middle, away from its ends."""
    lateral, pull = uniaxial(law, dim, stretch)
    assert (pull > 0) == (stretch > 1)
    x, volume = lattice([0.0] + [2.0] * (dim - 1), [LENGTH] + [1.0] * (dim - 1), DX / 2), (DX / 2) ** dim
    dt, omega = 0.25 * DX / np.sqrt(LAM + 2 * MU), np.pi / 2 / LENGTH * np.sqrt(E)
    model, inputs = world(
        x, size=[LENGTH * 2] + [5.0] * (dim - 1), dx=DX, dt=dt, substeps=int(24 / omega / dt), controls=1, mass=volume,
        volume=volume, nu=NU, damping=2 * omega, walls=[Wall(Slip, tuple(np.eye(dim)[0]), below(0, 0.0))], **{law: E},
    )  # fmt: skip
    end = x[:, 0] > LENGTH - 0.5
    inputs.fields.force[end, 0] = pull / end.sum()
    last = final(model, inputs)
    assert np.abs(last.v).max() < 1e-3
    middle = (x[:, 0] > 1.0) & (x[:, 0] < 2.5)
    F = last.F[middle].mean(0)
    assert F[0, 0] - 1 == pytest.approx(stretch - 1, rel=3e-3)
    for k in range(1, dim):
        assert F[k, k] - 1 == pytest.approx(lateral - 1, rel=3e-3)
    np.testing.assert_allclose(F - np.diag(np.diag(F)), 0.0, atol=1e-3)
