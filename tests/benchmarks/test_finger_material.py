"""CQ2 Fig 5's finger at full size: Young's modulus, Poisson's ratio and density from its motion."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cqrun.jobs.sysid import run_sysid

SCENE = Path(__file__).parents[2] / "scenes" / "sysid" / "finger_material.yaml"


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 0.01), (None, 0.03)], ids=["without noise", "with noise"])
def test_the_truth_is_found(noise, tolerance, tmp_path):
    """Within 1 % without noise, and 3 % with the noise that gives the printed floor of the loss."""
    overrides = [] if noise is None else [f"data.synthetic.noise={noise}"]
    run = run_sysid(SCENE, overrides, tmp_path, False, None, True)
    found = json.loads((run / "result.json").read_text())["unknowns"]
    truths = {"youngs_modulus": 20.0, "poissons_ratio": 0.25, "density": 2.33}
    for path, entry in found.items():
        assert entry["value"] == pytest.approx(truths[path.rpartition(".")[2]], rel=tolerance), path
