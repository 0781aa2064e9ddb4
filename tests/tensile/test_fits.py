"""Fits of all laws: they find the parameters that made a curve, their intervals cover them, and none is false."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from made_pulls import curve, ogden

from cqrun.errors import UsageError
from cqrun.materials.curves import MODES
from cqrun.tensile.certainty import certainty_of
from cqrun.tensile.choice import chosen, first_invariant, judge, one_of_each
from cqrun.tensile.fits import errors_by_mode, fit_law
from cqrun.tensile.laws import all_laws, laws_of
from cqrun.tensile.material import characterise, weaknesses

STRETCH = np.linspace(1.0, 3.0, 80)
TRUE = {
    "arruda_boyce": [3e5, 2.5],
    "fixed_corotated": [4e5],
    "gent": [2e5, 20.0],
    "mooney_rivlin": [1e5, 3e4],
    "neo_hookean": [5e5],
    "yeoh": [1e5, -2e3, 100.0],
}
"""Parameters that a test is made with."""


def law_of(name):
    return next(law for law in all_laws() if law.name == name)


def test_every_elastic_law_is_fitted():
    assert {law.name for law in all_laws()} >= TRUE.keys()
    assert [law.name for law in all_laws(["gent"])] == ["gent"]
    with pytest.raises(UsageError, match=r"--law gen: no elastic law has this name \(did you mean 'gent'\?\)"):
        all_laws(["gen"])


TOLD = [(name, mode) for name in TRUE for mode in MODES if (name, mode) != ("mooney_rivlin", "planar")]
"""Laws and tests that can tell their parameters: c10 and c01 have the same effect in planar tension."""


@pytest.mark.parametrize(("name", "mode"), TOLD)
def test_a_fit_finds_the_parameters_that_made_a_curve(name, mode):
    stretch = STRETCH if mode == "uniaxial" else np.linspace(1.0, 2.2, 60)
    law = law_of(name)
    fit = fit_law(law, [curve(law, TRUE[name], stretch, mode)])
    assert fit.values == pytest.approx(TRUE[name], rel=1e-4)
    assert fit.rms < 1e-6


@pytest.mark.parametrize("name", TRUE)
def test_intervals_cover_the_truth(name):
    """In most of 20 draws of the noise, and they are no wider than the scatter of the fits asks for."""
    law, true = law_of(name), np.array(TRUE[name])
    mu, covered, widths, values = law.moduli(true).shear, [], [], []
    for seed in range(20):
        fit = fit_law(law, [curve(law, true, STRETCH, noise=0.005, seed=seed)], near=true)
        certainty = certainty_of(fit)
        assert fit.rms == pytest.approx(0.005, rel=0.3)
        intervals = [*certainty.intervals.values(), certainty.shear]
        covered += [low < x < high for (low, high), x in zip(intervals, [*true, mu], strict=True)]
        widths.append([high - low for low, high in intervals[:-1]])
        values.append(fit.values)
    assert np.mean(covered) > 0.85
    assert np.all(np.median(widths, axis=0) < 8.0 * np.std(values, axis=0))  # four for independent errors


def test_a_modulus_that_is_hardly_determined_is_warned_about():
    law = law_of("neo_hookean")
    best = characterise([curve(law, TRUE["neo_hookean"], STRETCH, noise=0.005)], [law], 0.49).chosen
    assert weaknesses(best) == []
    vague = dataclasses.replace(best, certainty=dataclasses.replace(best.certainty, shear=(1e4, 1e6)))
    assert "its 95 % interval ends at 100 times where it begins" in weaknesses(vague)[0]


def test_numbered_fields_are_terms_and_both_terms_are_found():
    one, two, three = ogden()
    assert [p.name for p in two.parameters] == ["mu_1", "alpha_1", "mu_2", "alpha_2"]
    assert [law.title for law in (one, two, three)] == ["ogden, 1 term", "ogden, 2 terms", "ogden, 3 terms"]
    true = [4e5, 1.3, -2e3, -5.0]
    curves = [curve(two, true, np.linspace(1.0, 4.0, 60), mode, noise=0.002) for mode in MODES]
    fits = [fit_law(law, curves) for law in (one, two)]
    assert fits[1].values == pytest.approx(true, rel=0.1)
    assert one_of_each(fits) == [fits[1]]  # one term leaves a much larger error


def test_a_term_with_a_large_exponent_has_a_tiny_modulus():
    two = ogden()[1]
    stretch = np.linspace(1.0, 7.0, 60)
    fit = fit_law(two, [curve(two, [4e5, 1.5, 1e-13, 22.0], stretch)])
    assert fit.values == pytest.approx([4e5, 1.5, 1e-13, 22.0], rel=1e-2)
    assert fit.rms < 1e-5


def test_the_fewest_terms_that_fit_are_kept():
    one, two, _ = ogden()
    fits = [fit_law(law, [curve(one, [1e5, 2.0], STRETCH, noise=0.002)]) for law in (one, two)]
    assert one_of_each(fits) == [fits[0]]


def test_terms_that_a_scene_refuses_are_not_looked_for():
    """mu_k alpha_k has to be positive, also where terms of opposite signs would fit better."""
    two = ogden()[1]
    assert two.exponents == {0: 1, 2: 3}
    softening = curve(law_of("mooney_rivlin"), [1e5, -9e4], np.linspace(1.2, 3.0, 60))
    fit = fit_law(two, [softening])
    assert np.all(fit.values[::2] * fit.values[1::2] > 0.0)
    two.made(fit.values, 0.49)


@pytest.mark.parametrize("name", ["gent", "arruda_boyce", "yeoh", "ogden"])
def test_what_an_optimizer_moves_is_the_values_again(name):
    law = all_laws([name])[-1]
    values = np.array([2e5, 2.5, -300.0, -4.0, 1e3, 6.0][: len(law.parameters)])
    assert law.from_free(law.to_free(values, 1e5), 1e5) == pytest.approx(values, rel=1e-12)


def test_more_parameters_than_the_data_can_tell_get_no_false_interval():
    """A planar test alone cannot tell c10 from c01, and a straight line no three coefficients."""
    law = law_of("mooney_rivlin")
    fit = fit_law(law, [curve(law, TRUE["mooney_rivlin"], STRETCH, "planar", noise=0.002)])
    certainty = certainty_of(fit)
    assert certainty.intervals == {"c10": None, "c01": None}
    assert any("cannot be told apart" in finding for finding in certainty.findings)
    low, high = certainty.shear  # but their sum is well determined
    assert low < 2.6e5 < high < 1.1 * low


def test_as_many_points_as_parameters_give_no_interval():
    law = law_of("yeoh")
    certainty = certainty_of(fit_law(law, [curve(law, TRUE["yeoh"], np.array([1.1, 1.5, 2.5]))]))
    assert certainty.intervals == dict.fromkeys(("c10", "c20", "c30"))
    assert certainty.findings == ("no intervals: it has 3 points for 3 parameters",)


def test_smooth_errors_count_as_few_values():
    """A Neo-Hookean law fitted to a curve that stiffens: 80 points, but one misfit of the law's form."""
    gent = law_of("gent")
    certainty = certainty_of(fit_law(law_of("yeoh"), [curve(gent, [2e5, 8.0], STRETCH)]))
    assert certainty.samples < 12


def test_a_gent_law_never_ends_inside_the_data():
    gent = law_of("gent")
    data = curve(gent, [2e5, 7.0], np.linspace(1.0, 3.0, 50))
    assert first_invariant("uniaxial", data.stretch).max() - 3.0 == pytest.approx(6.667, abs=0.01)
    fit = fit_law(gent, [data])
    assert fit.values == pytest.approx([2e5, 7.0], rel=1e-4)
    (item,) = judge([fit], [data])
    assert item.stable["uniaxial"][1] == pytest.approx(3.06, abs=0.03)  # beyond it there is no stress
    assert not item.unstable_in


def test_a_law_that_is_unstable_inside_the_test_is_not_chosen():
    """A curve with a largest force: Yeoh's law follows it best, and no body would stand it."""
    yeoh = law_of("yeoh")
    data = curve(yeoh, [1e5, -8e3, 0.0], np.linspace(1.0, 3.4, 60))
    judged = judge([fit_law(yeoh, [data]), fit_law(law_of("gent"), [data])], [data])
    assert judged[0].fit.rms < 1e-6 < judged[1].fit.rms
    assert judged[0].unstable_in["uniaxial"] == pytest.approx(judged[0].stable["uniaxial"][1])
    assert judged[0].stable["uniaxial"][1] < 3.0
    assert chosen(judged).law.name == "gent"
    material = characterise([data], [yeoh], 0.49)
    assert any("unstable in uniaxial tests from a stretch of" in text for text in material.warnings)


def test_two_modes_are_compared_by_predicting_each_from_the_other():
    yeoh, mooney = law_of("yeoh"), law_of("mooney_rivlin")
    curves = [curve(yeoh, TRUE["yeoh"], STRETCH, noise=0.002)]
    curves.append(curve(yeoh, TRUE["yeoh"], np.linspace(1.0, 2.0, 30), "equibiaxial", noise=0.002))
    judged = judge([fit_law(law, curves) for law in (yeoh, mooney)], curves)
    assert judged[0].left_out.keys() == {"uniaxial", "equibiaxial"}
    assert judged[0].prediction < 0.02 < judged[1].prediction
    assert chosen(judged).law.name == "yeoh"
    assert errors_by_mode(yeoh, judged[0].fit.values, curves)["equibiaxial"] == pytest.approx(0.002, rel=0.5)


@pytest.mark.parametrize(
    ("factor", "words"), [(1000.0, "stiffer than any silicone"), (0.001, "softer than any silicone")]
)
def test_the_size_of_the_modulus_tells_wrong_units(factor, words):
    law = law_of("neo_hookean")
    material = characterise([curve(law, [factor * 4e5], STRETCH, noise=0.002)], [law], 0.49)
    assert any(words in text for text in material.warnings)
    assert not characterise([curve(law, [4e5], STRETCH, noise=0.002)], [law], 0.49).warnings


def test_a_law_that_no_scene_may_have_is_not_chosen():
    yeoh, gent = law_of("yeoh"), law_of("gent")
    data = curve(yeoh, TRUE["yeoh"], STRETCH, noise=0.002)
    judged = judge([fit_law(yeoh, [data]), fit_law(gent, [data])], [data])
    assert chosen(judged).law.name == "yeoh"
    negative = dataclasses.replace(judged[0].fit, values=np.array([-1.0, 0.0, 0.0]))
    refused = dataclasses.replace(judged[0], fit=negative)
    assert not refused.is_allowed
    assert chosen([refused, judged[1]]).law.name == "gent"


def test_what_was_not_tested_is_said():
    laws = [law_of(name) for name in ("yeoh", "mooney_rivlin")]
    trust = " ".join(characterise([curve(laws[0], TRUE["yeoh"], STRETCH, noise=0.002)], laws, 0.49).trust)
    for words in ("tested: uniaxial to a stretch of 3", "not tested: planar and equibiaxial", "not tested: compression",
                  "Mullins", "one specimen"):  # fmt: skip
        assert words in trust


def test_a_law_without_poissons_ratio_is_no_candidate():
    class Odd:
        model_fields = {}  # noqa: RUF012

    assert list(laws_of(Odd)) == []
