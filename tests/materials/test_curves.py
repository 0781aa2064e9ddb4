"""Nominal stress of every law in the tests of a laboratory, against textbook formulas; where a law is stable."""

from __future__ import annotations

import numpy as np
import pytest
from constitutive import elastic_names, make

from cqrun.materials.curves import MODES, nominal_slope, nominal_stress, stable_range, stable_to
from cqrun.plugin.registry import plugins

STRETCH = np.linspace(0.6, 3.0, 40)


def law(name, **values):
    """Return a law and its parameters, with nu = 0.49."""
    spec = plugins("elastic")[name](**values, poissons_ratio=0.49)
    return spec, np.array([getattr(spec, parameter) for parameter in spec.parameters])


def by_invariants(mode, stretch, W1, W2):
    """Return P from dW/dI1 and dW/dI2 (Rivlin's formulas for the three tests, each by itself)."""
    l = stretch  # noqa: E741 (as in the formulas)
    if mode == "uniaxial":
        return 2 * (l - l**-2) * (W1 + W2 / l)
    if mode == "planar":
        return 2 * (l - l**-3) * (W1 + W2)
    return 2 * (l - l**-5) * (W1 + l**2 * W2)


def first(mode, stretch):
    """Return I1 - 3 in a test."""
    second = stretch ** MODES[mode]
    return stretch**2 + second**2 + 1 / (stretch * second) ** 2 - 3


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("name", "values", "W1", "W2"),
    [
        ("mooney_rivlin", {"c10": 0.4, "c01": 0.1}, lambda x: 0.4, 0.1),
        ("yeoh", {"c10": 0.5, "c20": -0.02, "c30": 0.003}, lambda x: 0.5 - 0.04 * x + 0.009 * x**2, 0.0),
        ("gent", {"mu": 1.0, "jm": 40.0}, lambda x: 0.5 * 40.0 / (40.0 - x), 0.0),
        (
            "arruda_boyce",
            {"mu": 1.0, "lock": 2.5},
            lambda x: (
                1 / 2 + (x + 3) / 10 / 2.5**2 + 33 * (x + 3) ** 2 / 1050 / 2.5**4 + 76 * (x + 3) ** 3 / 7000 / 2.5**6
                + 2595 * (x + 3) ** 4 / 673750 / 2.5**8
            ),
            0.0,
        ),
    ],
)  # fmt: skip
def test_the_nominal_stress_is_that_of_the_textbook(mode, name, values, W1, W2):
    stretch = STRETCH[STRETCH < 2.0] if mode == "equibiaxial" else STRETCH
    spec, theta = law(name, **values)
    expected = by_invariants(mode, stretch, W1(first(mode, stretch)), W2)
    assert nominal_stress(spec, theta, mode, stretch) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("name", elastic_names())
def test_at_rest_the_slopes_are_those_of_hooke(name, rng):
    """3, 4 and 6 mu for a body that keeps its volume, and no stress."""
    term = make(name, 3, rng)
    mu = term.spec.shear_modulus(term.theta)
    for mode, times in (("uniaxial", 3.0), ("planar", 4.0), ("equibiaxial", 6.0)):
        assert nominal_stress(term.spec, term.theta, mode, np.ones(12)) == pytest.approx(0.0, abs=1e-12)
        assert nominal_slope(term.spec, term.theta, mode, np.ones(12)) == pytest.approx(times * mu, rel=1e-6)


def test_a_law_that_softens_is_stable_up_to_its_largest_force():
    spec, theta = law("yeoh", c10=0.5, c20=-0.05)
    _, high = stable_range(spec, theta, "uniaxial")
    fine = np.linspace(1.0, 4.0, 30001)
    largest = fine[np.argmax(nominal_stress(spec, theta, "uniaxial", fine))]
    assert high == pytest.approx(largest, rel=0.01)
    assert stable_to(spec, theta)["equibiaxial"] < high


def test_stability_is_looked_for_as_far_as_asked():
    spec, theta = law("yeoh", c10=0.5)
    assert stable_range(spec, theta, "uniaxial", 25.0) == (1 / 25.0, 25.0)
    falls, theta = law("yeoh", c10=0.5, c20=-1e-4)
    assert stable_range(falls, theta, "uniaxial") == (0.1, 10.0)
    assert 10.0 < stable_range(falls, theta, "uniaxial", 60.0)[1] < 60.0


def test_a_law_that_stiffens_is_stable_everywhere():
    spec, theta = law("mooney_rivlin", c10=0.4, c01=0.1)
    assert stable_to(spec, theta) == dict.fromkeys(MODES, 10.0)


def test_beyond_its_limit_gent_is_not_stable():
    spec, theta = law("gent", mu=1.0, jm=10.0)
    limit = stable_to(spec, theta)["uniaxial"]
    x = limit**2 + 2 / limit - 3
    assert x == pytest.approx(10.0, rel=0.03)
