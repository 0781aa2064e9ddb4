"""Young's moduli that a fit reports for laws whose parameters are none, and against a sudden change."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.fitting.identifiability import Unknown
from cqrun.fitting.stiffness import LONG, ONCE, fitted_moduli
from cqrun.fitting.uncertainty import Uncertainty
from cqrun.scene.load import load_scene

SCENE = {
    "cqrun": 1,
    "world": {"size": [0.2, 0.2], "dx": 0.02},
    "bodies": {
        "beam": {
            "shape": {"box": {"corner": [0.05, 0.05], "size": [0.1, 0.1]}},
            "particles_per_cell": 4,
            "material": {
                "density": 1000,
                "elastic": {"yeoh": {"c10": 100.0, "c20": 0.0, "c30": 0.0, "poissons_ratio": 0.4999}},
                "prony": {"ratio_1": 0.2, "time_1": 0.1},
            },
        }
    },
    "time": {"duration": 0.1, "control_step": 0.01},
}
LAW = "bodies.beam.material.elastic.yeoh"


def known(unknowns, errors):
    p = len(unknowns)
    covariance = np.diag(np.square(errors))
    return Uncertainty(dict.fromkeys(u.name for u in unknowns), {}, (), covariance, np.full(p, 1e6))


def test_moduli_follow_from_the_law_and_the_branches():
    scene = load_scene(SCENE)
    unknowns = [
        Unknown(f"{LAW}.c10", 110.0, 50.0, 500.0, log=True),
        Unknown("bodies.beam.material.prony.ratio_1", 0.3, 0.0, 1.0),
        Unknown("bodies.beam.material.prony.time_1", 0.1, 0.01, 1.0, log=True),
        Unknown("loads.air.damping.rate", 1.0, 0.1, 10.0, log=True),
    ]
    found = fitted_moduli(scene, unknowns, known(unknowns, [0.01, 0.013, 5.0, 0.1]))["beam"]
    assert found[LONG].value == pytest.approx(2 * 110 * 2 * 1.4999, rel=1e-6)  # E = 2 mu (1 + nu), mu = 2 c10
    assert found[ONCE].value == pytest.approx(1.3 * found[LONG].value, rel=1e-4)  # K hardly counts
    half = 1.959964 * 0.01
    np.testing.assert_allclose(np.log(np.array(found[LONG].interval) / found[LONG].value), [-half, half], rtol=1e-3)
    half = 1.959964 * np.hypot(0.01, 0.013 / 1.3)
    np.testing.assert_allclose(np.log(np.array(found[ONCE].interval) / found[ONCE].value), [-half, half], rtol=1e-3)


def test_without_an_uncertainty_there_is_no_interval():
    unknowns = [Unknown(f"{LAW}.c10", 110.0, 50.0, 500.0, log=True)]
    for moduli in (
        fitted_moduli(load_scene(SCENE), unknowns, None),
        fitted_moduli(load_scene(SCENE), unknowns, known(unknowns, [np.nan])),
    ):
        assert all(modulus.interval is None for modulus in moduli["beam"].values())


def test_a_modulus_that_is_an_unknown_is_not_told_twice():
    elastic = "bodies.beam.material.elastic={neo_hookean: {youngs_modulus: 500, poissons_ratio: 0.4}}"
    scene = load_scene(SCENE, [elastic, "bodies.beam.material.prony=null"])
    path = "bodies.beam.material.elastic.neo_hookean.youngs_modulus"
    assert fitted_moduli(scene, [Unknown(path, 500.0, 100.0, 900.0)], None) == {}


@pytest.mark.parametrize("name", [f"{LAW}.c10[0]", "bodies.beam.material.density", "loads.air.damping.rate"])
def test_a_body_without_one_law_of_its_own_has_none(name):
    scene = load_scene(SCENE)
    assert fitted_moduli(scene, [Unknown(name, 100.0, 50.0, 500.0)], None) == {}


@pytest.mark.parametrize("ratio", [0.0, 1.0e-5, 1.0])
def test_a_value_at_its_bound_has_moduli(ratio):
    """Beyond its bound it would be no ratio."""
    unknowns = [Unknown("bodies.beam.material.prony.ratio_1", ratio, 0.0, 1.0)]
    found = fitted_moduli(load_scene(SCENE), unknowns, known(unknowns, [0.013]))["beam"]
    assert LONG not in found  # no unknown changes it
    half = 1.959964 * 0.013 / (1 + ratio)
    np.testing.assert_allclose(np.log(np.array(found[ONCE].interval) / found[ONCE].value), [-half, half], rtol=1e-3)


def test_a_poissons_ratio_next_to_one_half_has_a_modulus():
    unknowns = [Unknown(f"{LAW}.poissons_ratio", 0.49995, 0.3, 0.49999)]
    found = fitted_moduli(load_scene(SCENE), unknowns, known(unknowns, [1e-4]))["beam"]
    half = 1.959964 * 1e-4 / 1.49995
    np.testing.assert_allclose(np.log(np.array(found[LONG].interval) / found[LONG].value), [-half, half], rtol=1e-2)
