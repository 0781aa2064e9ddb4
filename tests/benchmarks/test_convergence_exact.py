"""The closed references of the convergence tables: elastica, column, ring, contact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from benchmarks.convergence.elastica import column, column_from_ode, elastica, euler_load, plate_stiffness
from benchmarks.convergence.hertz import BallContact, LineContact
from benchmarks.convergence.ring import EXAMPLE


@pytest.mark.parametrize(
    ("load", "along", "across"), [(1.0, 0.05643, 0.30172), (3.0, 0.25442, 0.60325), (10.0, 0.55500, 0.81061)]
)
def test_the_elastica_is_that_of_the_literature(load, along, across):
    """Mattiasson 1981, table 1, from elliptic integrals; five digits."""
    bent = elastica(load)
    assert -bent.along == pytest.approx(along, abs=6e-6)
    assert bent.across == pytest.approx(across, abs=6e-6)


def test_a_small_load_bends_the_elastica_as_a_linear_beam():
    bent = elastica(1e-3)
    assert bent.across == pytest.approx(1e-3 / 3.0, rel=1e-6)
    assert bent.angle == pytest.approx(1e-3 / 2.0, rel=1e-6)
    assert -bent.along == pytest.approx(1e-6 / 15.0, rel=1e-4)  # half the integral of (s - s^2 / 2)^2


def test_a_load_of_zero_bends_nothing():
    assert (elastica(0.0).along, elastica(0.0).across) == (0.0, 0.0)


@pytest.mark.parametrize("ratio", [1.02, 1.1, 1.5, 2.5])
def test_the_column_is_the_same_from_elliptic_integrals_and_from_its_equation(ratio):
    closed, integrated = column(ratio), column_from_ode(ratio)
    for name in ("along", "across", "angle"):
        assert getattr(integrated, name) == pytest.approx(getattr(closed, name), rel=1e-8)


def test_the_column_buckles_at_the_euler_load():
    """Just above it, (angle)^2 = 16 (sqrt(ratio) - 1) to first order, and the shape is a quarter of a cosine."""
    bent = column(1.0 + 1e-5)
    assert bent.angle**2 == pytest.approx(16.0 * 0.5e-5, rel=1e-3)
    assert bent.across == pytest.approx(2.0 / np.pi * bent.angle, rel=1e-3)
    with pytest.raises(ValueError, match="above 1"):
        column(0.9)


def test_stiffness_and_euler_load_have_their_units():
    assert plate_stiffness(12.0, 0.5, 1.0) == pytest.approx(4.0 / 3.0)
    assert euler_load(4.0, 2.0) == pytest.approx(np.pi**2 / 4.0)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.499])
def test_the_ring_is_in_equilibrium_and_its_stress_is_that_of_its_strain(nu):
    """(r s_r)' = s_t; s_r and s_t from u by Hooke's law in plane strain; -p inside, nothing outside."""
    ring = replace(EXAMPLE, poissons_ratio=nu)
    r, h = np.linspace(ring.inner, ring.outer, 7), 1e-7
    force = ((r + h) * ring.radial_stress(r + h) - (r - h) * ring.radial_stress(r - h)) / (2 * h)
    np.testing.assert_allclose(force, ring.hoop_stress(r), rtol=1e-6)
    strain = np.array([(ring.displacement(r + h) - ring.displacement(r - h)) / (2 * h), ring.displacement(r) / r])
    mu = ring.youngs_modulus / (2 * (1 + nu))
    lam = 2 * mu * nu / (1 - 2 * nu)
    stress = 2 * mu * strain + lam * strain.sum(0)
    np.testing.assert_allclose(stress[0], ring.radial_stress(r), atol=1e-4 * ring.pressure)
    np.testing.assert_allclose(stress[1], ring.hoop_stress(r), rtol=1e-4)
    np.testing.assert_allclose(ring.radial_stress(np.array([ring.inner, ring.outer])), [-ring.pressure, 0], atol=1e-9)


def test_the_pressure_of_a_contact_sums_to_its_force():
    line, ball = LineContact(0.02, 3e5, 0.45, 20.0), BallContact(0.02, 3e5, 0.45, 0.2)
    total = quad(lambda x: float(line.pressure(np.array(x))), -line.half_width, line.half_width)[0]
    assert total == pytest.approx(line.force, rel=1e-6)
    total = quad(lambda r: 2 * np.pi * r * float(ball.pressure(np.array(r))), 0, ball.contact_radius)[0]
    assert total == pytest.approx(ball.force, rel=1e-6)


def test_the_surface_under_a_contact_is_flat():
    """A half-space under the line pressure (Flamant) bends up as the disc bends down: u'' = -1/R inside the contact.

    u(x) = -(2 / pi E*) int p(s) log|x - s| ds. The contact is flat only for the half-width of Hertz.
    """
    line = LineContact(0.02, 3e5, 0.3, 2.0)
    a, modulus = line.half_width, 3e5 / (1 - 0.3**2)
    angle = (np.arange(200_000) + 0.5) * np.pi / 200_000  # s = a cos t: the rule is exact for the root at the ends
    s = a * np.cos(angle)
    weight = line.pressure(s) * a * np.sin(angle) * np.pi / 200_000

    def sink(x: float) -> float:
        return float(-2.0 / (np.pi * modulus) * (weight * np.log(np.abs(x - s))).sum())

    drop = sink(0.0) - sink(0.6 * a)
    assert drop == pytest.approx((0.6 * a) ** 2 / (2 * line.radius), rel=1e-3)


def test_the_approach_of_a_disc_is_the_sum_of_its_strains():
    """Johnson 1985, eqs 5.54 and 5.55: stresses under the contact, along the line to the disc's centre.

    The disc is loaded by the same force on its far side. The formula drops terms of order (a / R)^2.
    """
    line = LineContact(0.02, 3e5, 0.3, 2.0)
    a, R, P, nu = line.half_width, line.radius, line.force, line.poissons_ratio

    def strain(z: float) -> float:
        root = np.sqrt(a**2 + z**2)
        across = P / np.pi * (1 / R - 2 * (a**2 + 2 * z**2) / (a**2 * root) + 4 * z / a**2)
        along = P / np.pi * (1 / R - 2 / (2 * R - z) - 2 / root)
        return float((1 - nu**2) / line.youngs_modulus * (along - nu / (1 - nu) * across))

    assert a / R < 0.03
    assert -quad(strain, 0.0, R, points=[a], epsrel=1e-10)[0] == pytest.approx(line.approach, rel=2e-3)


def test_contacts_grow_with_the_force_as_hertz_says():
    line, ball = LineContact(0.02, 3e5, 0.45, 20.0), BallContact(0.02, 3e5, 0.45, 0.2)
    assert replace(line, force=80.0).half_width == pytest.approx(2.0 * line.half_width)
    assert replace(ball, force=1.6).contact_radius == pytest.approx(2.0 * ball.contact_radius)
    # the work of the force is the energy that the approach stores: dU = P d(approach), with U = 2/5 P approach
    h = 1e-6
    slope = (replace(ball, force=0.2 + h).approach - replace(ball, force=0.2 - h).approach) / (2 * h)
    assert slope == pytest.approx(2.0 / 3.0 * ball.approach / ball.force, rel=1e-6)
