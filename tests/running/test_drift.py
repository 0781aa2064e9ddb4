"""Positions that have drifted from the deformation gradient are reported, in the frame where they can."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.build.model import build
from cqrun.engine.frames import make_rollout
from cqrun.running.drift import drift, drift_findings
from cqrun.running.observables import fracture_of
from cqrun.scene.load import load_scene
from cqrun.state import State

MATERIAL = {"density": 1000, "elastic": {"fixed_corotated": {"youngs_modulus": 1e4, "poissons_ratio": 0.3}}}


def bar(frame):
    """Return a free bar of 8 x 2 cells that turns nine times."""
    shape = {"box": {"corner": [0.3, 0.45], "size": [0.4, 0.1]}}
    body = {"shape": shape, "particles_per_cell": 4, "material": MATERIAL, "spin": [6 * np.pi]}
    world, time = {"size": [1, 1], "dx": 0.05, "frame": frame}, {"duration": 3.0, "control_step": 0.5}
    return build(load_scene({"cqrun": 1, "world": world, "bodies": {"bar": body}, "time": time}))


def end_of(built):
    """Return the last state of a motion."""
    rollout = make_rollout(built.model, built.assembly.inputs({}))
    rollout.run()
    return rollout.unpack(rollout.final, built.model.n_controls)


def test_a_bar_that_turns_drifts_in_the_updated_frame_alone():
    built = bar("updated")
    last = end_of(built)
    (finding,) = drift_findings(built, last)
    assert finding.startswith("bar: at the end, neighbours are ")
    size = drift(fracture_of(built).pairs["bar"], built.particles.x, last)
    assert 0.01 < size < 0.1
    assert f"{100 * size:.1f} % farther apart" in finding
    reference = bar("reference")
    there = end_of(reference)
    assert list(drift_findings(reference, there)) == []
    assert drift(fracture_of(built).pairs["bar"], reference.particles.x, there) < 0.4 * size


def test_an_affine_motion_has_no_drift(rng):
    built = bar("updated")
    x = built.particles.x
    F = np.eye(2) + 0.2 * rng.normal(size=(2, 2))
    state = State(x @ F.T, np.zeros_like(x), np.zeros((*x.shape, 2)), np.broadcast_to(F, (*x.shape, 2)))
    assert drift(fracture_of(built).pairs["bar"], x, state) == pytest.approx(0.0, abs=1e-12)
    assert list(drift_findings(built, state)) == []
