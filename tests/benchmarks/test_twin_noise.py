"""A twin of known material: what identification finds from its motion with 0, 1 and 5 % of noise (peers' last case).

A cantilever in 2D, bent by two muscles of known strength, which tell its modulus from its density, is followed at
twenty particles. Noise is a share of the body's root mean square displacement;
all three are found within twice that share, Poisson's ratio the least well.
"""

from __future__ import annotations

import numpy as np
import pytest

import cqrun
from cqrun.jobs.sysid import run_sysid
from cqrun.store.result import SysidResult, require_result

TRUTH = {"youngs_modulus": 4.0e4, "poissons_ratio": 0.3, "density": 1000.0}
TWIN = """
cqrun: 1
world: {size: [0.24, 0.16], dx: 0.01, gravity: [0, -9.81], frame: updated}
bodies:
  beam:
    shape: {box: {corner: [0.03, 0.07], size: [0.13, 0.03]}}
    particles_per_cell: 4
    groups:
      top: {box: {corner: [0.06, 0.085], size: [0.1, 0.015]}}
      bottom: {box: {corner: [0.06, 0.07], size: [0.1, 0.015]}}
    material: {density: 1150, elastic: {neo_hookean: {youngs_modulus: 3.0e4, poissons_ratio: 0.38}}}
boundaries: {clamp: {sticky: {region: {box: {corner: [0, 0], size: [0.05, 0.16]}}}}}
loads: {air: {damping: {rate: 2}}}
actuators:
  top: {muscle: {body: beam, region: top, axis: [1, 0], strength: 4000}}
  bottom: {muscle: {body: beam, region: bottom, axis: [1, 0], strength: 4000}}
activation: {signals: {top: [0, 1, 0.2, 0.8], bottom: [0.7, 0, 0.9, 0.1]}}
time: {duration: 0.4, control_step: 0.01}
data: {synthetic: {truth: {TRUTH}, noise: NOISE, seed: 3, tracked: 20, every: 1}}
unknowns:
  bodies.beam.material.elastic.neo_hookean.youngs_modulus: {bounds: [2.0e4, 8.0e4], scale: log}
  bodies.beam.material.elastic.neo_hookean.poissons_ratio: {bounds: [0.1, 0.45]}
  bodies.beam.material.density: {bounds: [500, 2000], scale: log}
optimizer: {least_squares: {max_iterations: 20}}
"""
PATHS = {name: f"bodies.beam.material.{'' if name == 'density' else 'elastic.neo_hookean.'}{name}" for name in TRUTH}


@pytest.mark.parametrize(("percent", "error"), [(0, 1e-6), (1, 0.02), (5, 0.10)])
def test_modulus_ratio_and_density_are_found(percent, error, tmp_path):
    truth = ", ".join(f"{PATHS[name]}: {value}" for name, value in TRUTH.items())
    text = TWIN.replace("TRUTH", truth)
    x = cqrun.load(text.replace("NOISE", "0"), threads=1).simulate({PATHS[n]: value for n, value in TRUTH.items()}).x
    moved = float(np.sqrt(((x - x[0]) ** 2).sum(axis=2).mean()))
    scene = tmp_path / "twin.yaml"
    scene.write_text(text.replace("NOISE", repr(percent / 100 * moved)))
    run = run_sysid(scene, (), tmp_path / "out", threads=1)
    found = require_result(run, SysidResult)
    assert found.status == "converged"
    for name, value in TRUTH.items():
        entry = found.unknowns[PATHS[name]]
        assert entry.value == pytest.approx(value, rel=error), name
        if percent:
            low, high = entry.interval
            assert low <= value <= high, name
