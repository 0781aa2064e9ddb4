"""What is committed under benchmarks/measured says what is asked of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

MEASURED = Path(__file__).parents[2] / "benchmarks" / "measured"
MODULUS = "bodies.beam.material.elastic.fixed_corotated.youngs_modulus"
VISCOSITY = "bodies.beam.material.viscosity.shear"
FITS = ("swing", "swing_bare", "swing_fine", "rest", "rest_bare", "rest_fine")
NOT_YET = {"swing_bare"}
"""Fits of hours that were not made again since the clamp of the scenes is longer."""


def kept(name: str) -> dict[str, Any]:
    return json.loads((MEASURED / f"{name}.json").read_text())


def test_the_collisions_optimum_is_that_of_a_scan():
    """The paper found 2.26 with one sampling of unknown seed: it lies among ours."""
    told = kept("collision_seeds")
    found, scans = (np.array([row[key] for row in told["rows"]]) for key in ("gradient", "scan"))
    assert len(found) == 10
    assert np.abs(found / scans - 1.0).max() <= 1e-3
    assert found.min() <= 2.26 <= found.max()
    assert told["summary"]["mean"] == pytest.approx(found.mean())


@pytest.mark.parametrize("clamp", ["scenes", "source"])
@pytest.mark.parametrize("name", FITS)
def test_the_real_beam(name, clamp):
    """Fitted: .6 mm bare and 2.0 mm loaded; E within what is known of the silicone."""
    told = kept("real_beam")
    if clamp == "scenes" and name in NOT_YET:
        assert name not in told
        pytest.skip("this fit takes hours and was not made again with the longer clamp")
    entry = (told if clamp == "scenes" else told["source_clamp"])[name]
    assert entry["status"] == "converged"
    assert 230e3 <= entry["unknowns"][MODULUS]["value"] <= 360e3
    low, high = entry["unknowns"][MODULUS]["interval"]
    assert low < entry["unknowns"][MODULUS]["value"] < high
    for recording, limit in (("bare", 0.6), ("loaded", 2.0)):
        found = entry["recordings"][recording]
        assert found["holdout"] or found["rmse_mm"] <= limit


def test_the_loaded_beam_at_rest_is_predicted():
    """From the bare recording alone, within 2.5 mm; with the clamp of the scenes within 1.25 mm."""
    told = kept("real_beam")
    assert told["source_clamp"]["rest_predicted_from_swing_bare_mm"]["loaded"] <= 2.5
    for of, limit in ((told["source_clamp"], 2.5), (told, 1.25)):
        assert of["rest_bare"]["recordings"]["loaded"]["holdout"]
        assert of["rest_bare"]["recordings"]["loaded"]["rmse_mm"] <= limit


def test_the_real_beam_does_not_depend_on_the_grid():
    """Two grids: E within 2 %, the viscosity within 15 %."""
    told = kept("real_beam")
    for of in (told["source_clamp"], told):
        for kind in ("swing", "rest"):
            coarse, fine = (of[name]["unknowns"] for name in (kind, f"{kind}_fine"))
            assert fine[MODULUS]["value"] == pytest.approx(coarse[MODULUS]["value"], rel=0.02)
        coarse, fine = (of[name]["unknowns"][VISCOSITY]["value"] for name in ("swing", "swing_fine"))
        assert fine == pytest.approx(coarse, rel=0.15)


def test_the_reference_frame_fits_the_real_beam_better_than_the_updated_frame():
    """Its errors [mm] on cells of 5 and 3.75 mm were 0.365 and 0.524 bare, 1.720 and 1.709 loaded."""
    told = kept("real_beam")
    for name, bare, loaded in (("swing", 0.365, 1.720), ("swing_fine", 0.524, 1.709)):
        assert told[name]["recordings"]["bare"]["rmse_mm"] <= bare
        assert told[name]["recordings"]["loaded"]["rmse_mm"] <= loaded


def test_the_longer_clamp_explains_the_real_beam_better():
    """Errors are no larger than those of the updated frame, which has the clamp of the source."""
    told = kept("real_beam")
    for name, bare, loaded in (("swing", 0.365, 1.720), ("rest", 0.292, 1.366), ("rest_fine", 0.406, 1.410)):
        errors = told[name]["recordings"]
        assert errors["bare"]["rmse_mm"] <= bare
        assert errors["loaded"]["rmse_mm"] <= loaded


def test_the_tentacle():
    """Eight poses, two grids: below 8 mm; both moduli are between the fitted and the first value of the source."""
    told = kept("tentacle")
    modulus = "bodies.arm.material.elastic.fixed_corotated.youngs_modulus"
    for name in ("coarse", "fine"):
        assert told[name]["status"] == "converged"
        assert all(315e3 <= value <= 505e3 for value in told[name]["unknowns"][modulus]["value"])
        assert told[name]["recordings"]["poses"]["mean_mm"] < 8.0 < told["rod_model_mm"]
    coarse, fine = (told[name]["unknowns"][modulus]["value"] for name in ("coarse", "fine"))
    assert fine == pytest.approx(coarse, rel=0.02)


def test_robots_of_the_papers_learn_in_both_frames():
    """The finger comes as near as in the paper, the arm keeps its constraints, the biped walks."""
    told = kept("both_frames")
    for frame in ("updated", "reference"):
        assert told["finger"][frame]["loss"] <= 0.01
        for constraint in told["arm_two_link"][frame]["constraints"].values():
            assert constraint["violation"] <= 1e-5
        assert told["biped"][frame]["terms"]["far"] >= 0.2
