"""What is special in laws of rubber: equal principal stretches, limits, and what a scene may give."""

from __future__ import annotations

import numpy as np
import pytest
from constitutive import N, make, richardson, rotations, t

from cqrun.materials.gent import Gent
from cqrun.materials.mooney_rivlin import MooneyRivlin
from cqrun.materials.ogden import Ogden
from cqrun.materials.yeoh import Yeoh

DIM = pytest.mark.parametrize("dim", [2, 3], ids=["2D", "3D"])
DOT_PRODUCT = 1e-9


@pytest.mark.parametrize("name", ["ogden", "ogden:3"])
@pytest.mark.parametrize("apart", [0.0, 1e-15, 1e-12, 1e-8, 1e-4, 0.0999, 0.1001])
@DIM
def test_ogden_with_equal_and_nearly_equal_stretches(name, apart, dim, rng):
    """The adjoint against differences, where principal stretches are equal, almost equal, and at the series' end."""
    term = make(name, dim, rng)
    stretches = 1.3 * np.exp(np.outer(rng.uniform(-1, 1, N), 0.5 * apart * np.array([1.0, -1.0, 0.3])[:dim]))
    Q, R = rotations(dim, rng), rotations(dim, rng)
    F = Q @ (stretches[:, :, None] * t(R)) if dim == 3 else Q @ (stretches[:, :, None] * R)
    F_dot, tau_bar, C = rng.normal(size=F.shape), rng.normal(size=F.shape), np.zeros_like(F)
    forward = richardson(lambda h: (term.tau(F + h * F_dot, C) * tau_bar).sum((1, 2)))
    backward = (term.vjp(F, C, tau_bar)[1] * F_dot).sum((1, 2))
    np.testing.assert_allclose(backward, forward, rtol=0, atol=DOT_PRODUCT * np.abs(forward).max())


def test_a_state_beyond_gents_limit_has_no_stress(rng):
    term, F = make("gent", 3, rng), np.tile(np.diag([4.0, 0.5, 0.5]), (N, 1, 1))
    assert np.isnan(term.tau(F, 0 * F)).all()  # (the sign of the formula's stress is wrong there)


@pytest.mark.parametrize(
    ("law", "given", "message"),
    [
        (Yeoh, {"c10": 1.0}, "needs one of `poissons_ratio`"),
        (Gent, {"mu": 1.0, "jm": 9.0, "poissons_ratio": 0.4, "bulk_modulus": 9.0}, "needs one of `poissons_ratio`"),
        (MooneyRivlin, {"c10": 1.0, "c01": -2.0, "poissons_ratio": 0.4}, "c10 \\+ c01, must be above 0, is -1"),
        (Ogden, {"mu_1": 1.0, "alpha_1": -2.0, "poissons_ratio": 0.4}, "mu_1 alpha_1 must be above 0, is -2"),
        (
            Ogden,
            {"mu_1": 1.0, "alpha_1": 2.0, "mu_2": 1.0, "poissons_ratio": 0.4},
            "a term needs both mu_2 and alpha_2",
        ),
        (
            Ogden,
            {"mu_1": 1.0, "alpha_1": 2.0, "mu_3": 1.0, "alpha_3": 2.0, "poissons_ratio": 0.4},
            "is given, but no second term: call it mu_2 and alpha_2",
        ),
    ],
)
def test_what_is_no_law_is_refused(law, given, message):
    with pytest.raises(ValueError, match=message):
        law(**given)


@DIM
def test_fibres_that_only_pull_do_not_push(dim, rng):
    slack = make("fibre:t", dim, rng)
    both_ways = make("fibre", dim, rng)
    F = np.tile(np.eye(dim), (N, 1, 1))
    for stretch in (0.8, 1.25):
        F[:, 0, 0] = stretch
        tau = both_ways.tau(F, 0 * F)[:, 0, 0]
        assert tau == pytest.approx(0.5 * both_ways.theta[0] * (stretch**2 - 1) * stretch**2, rel=1e-12)
        pulled = slack.tau(F, 0 * F)[:, 0, 0]
        expected = 0.5 * slack.theta[0] * (stretch**2 - 1) * stretch**2 if stretch > 1 else 0.0 * pulled
        assert pulled == pytest.approx(expected, rel=1e-12)
    assert (slack.spec.wave_modulus(slack.theta) >= slack.theta[0]).all()
