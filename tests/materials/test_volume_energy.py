"""The part of an energy that depends on the volume alone: its slope, its adjoint, and what is left of the stress."""

from __future__ import annotations

import numpy as np
import pytest
from constitutive import N, all_names, elastic_names, make, states

from cqrun.materials import term

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
ELASTIC = pytest.mark.parametrize("name", elastic_names())


def close(got: np.ndarray, want: np.ndarray) -> None:
    """Assert that arrays agree relative to the largest entry."""
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * max(np.abs(want).max(), 1e-3))


@pytest.mark.parametrize(
    "name", [name for name in all_names() if term.has_volume(type(make(name, 3, np.random.default_rng(0)).kernel))]
)
def test_the_slope_of_the_energy_of_volume(name, rng):
    law, J, J_bar, h = make(name, 3, rng), rng.uniform(0.7, 1.4, N), rng.normal(size=N), 1e-30j

    def slope(theta, J):
        return term.volume_slope(law.kernel, tuple(theta), J)

    theta_bar, through_J = term.volume_slope_vjp(law.kernel, tuple(law.theta), J, J_bar)
    close(through_J, slope(law.theta + 0j, J + h).imag / 1e-30 * J_bar)
    for row, found in enumerate(theta_bar):
        moved = law.theta + 0j
        moved[row] += h
        close(found + np.zeros(N), slope(moved, J + 0j).imag / 1e-30 * J_bar)


@ELASTIC
@DIM
def test_without_the_energy_of_volume_a_stress_stays_finite_as_nu_nears_a_half(name, dim, rng):
    """This is what lets averaged volumes cure locking: the particles' own stress no longer knows of lambda."""
    law, (F, C) = make(name, dim, rng), states(dim, rng)
    if not term.has_volume(type(law.kernel)):
        pytest.skip("this law has no energy of volume")
    rest, whole = [], []
    for nu in (0.49, 0.4999):
        theta = law.theta.copy()
        theta[-1] = nu
        J = np.linalg.det(F)
        own = (J * term.volume_slope(law.kernel, tuple(theta), J))[:, None, None] * np.eye(dim)
        whole.append(np.abs(law.tau(F, C, theta)).max())
        rest.append(np.abs(law.tau(F, C, theta) - own).max())
    assert whole[1] > 20 * whole[0]
    assert rest[1] == pytest.approx(rest[0], rel=0.02)
