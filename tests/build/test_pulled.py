"""The substep of bodies that are pulled far: waves as fast as in the stretched material."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.build.model import Built, build
from cqrun.engine.frames import make_rollout
from cqrun.errors import RolloutError
from cqrun.materials.waves import nominal, pulled, wave_stiffness
from cqrun.plugin.registry import plugins
from cqrun.scene.load import load_scene

LAWS = {
    "yeoh": {"c10": 2.5e4, "c30": 5e3, "poissons_ratio": 0.3},
    "gent": {"mu": 5e4, "jm": 8.0, "poissons_ratio": 0.3},
    "ogden": {"mu_1": 1e3, "alpha_1": 8.0, "poissons_ratio": 0.3},
    "neo_hookean": {"youngs_modulus": 1.3e5, "poissons_ratio": 0.45},
}


def bar(law: str, pull: float, frame: str = "reference", *, more: Any = None, turn: float = 0.0, **time: Any) -> Built:
    """Return a bar whose free part, 0.05 m, is pulled longer by `pull` [m], and turned; `more` are sections."""
    head: dict[str, Any] = {"region": {"box": {"corner": [0.09, 0], "size": [0.02, 0.06]}}}
    head |= {"displacement": [pull, 0]} if pull else {}
    head |= {"rotation": [turn]} if turn else {}
    return build(load_scene({
        "cqrun": 1, "world": {"size": [0.4, 0.06], "dx": 0.005, "frame": frame},
        "bodies": {"bar": {
            "shape": {"box": {"corner": [0.02, 0.02], "size": [0.09, 0.02]}}, "particles_per_cell": 4,
            "material": {"density": 1070, "elastic": {law: LAWS[law]}},
        }},
        "boundaries": {"foot": {"sticky": {"region": {"box": {"corner": [0, 0], "size": [0.04, 0.06]}}}},
                       "head": {"sticky": head}},
        "time": {"duration": 0.28, "control_step": 0.01, **time}, **(more or {}),
    }))  # fmt: skip


@needs_jit
@pytest.mark.parametrize("law", LAWS)
def test_auto_steps_hold_for_a_bar_that_is_pulled_to_three_times_its_length(law):
    """With the steps of the bar at rest, all but neo-Hookean blow up at stretches of 2 to 2.5."""
    built = bar(law, 0.1)
    names = [limit.part for limit in built.limits]
    assert "bodies.bar.material at a stretch of 2.9" in names
    rollout = make_rollout(built.model, built.assembly.inputs({}))
    x = []
    rollout.run(observe=lambda _, state: x.append(state.x[:, 0].max()))
    assert x[-1] - x[0] == pytest.approx(0.1, rel=1e-3)


def test_a_small_pull_needs_no_other_steps():
    assert bar("yeoh", 0.015).model.substeps == bar("yeoh", 0.0).model.substeps


@needs_jit
def test_a_law_beyond_its_limit_is_told_where_it_is_stretched_most(monkeypatch):
    monkeypatch.setitem(LAWS, "gent", {"mu": 5e4, "jm": 1.0, "poissons_ratio": 0.3})
    built = bar("gent", 0.1, substeps=150)
    with pytest.raises(RolloutError, match="has no stress from I1b - 3 = jm on") as error:
        make_rollout(built.model, built.assembly.inputs({})).run()
    assert error.value.particle is not None
    assert 0.035 < built.particles.x[error.value.particle, 0] < 0.095


@pytest.mark.parametrize("frame", ["reference", "updated"])
def test_the_stretch_can_be_given(frame):
    plain, given = bar("yeoh", 0.0, frame), bar("yeoh", 0.0, frame, stretch=3.0)
    assert given.model.substeps > 2 * plain.model.substeps


def test_a_given_stretch_replaces_that_of_clamps():
    assert bar("yeoh", 0.1, stretch=1.2).model.substeps == bar("yeoh", 0.0).model.substeps


def test_given_substeps_are_not_refused_for_a_pull():
    built = bar("yeoh", 0.1, substeps=40)
    assert built.model.substeps == 40
    (warning,) = map(str, built.warnings)
    assert "is stable at the start, but waves need" in warning
    assert "(bodies.bar.material at a stretch of 2.9)" in warning


def test_mirrored_turns_need_the_same_steps():
    assert bar("yeoh", 0.05, turn=0.6).model.substeps == bar("yeoh", 0.05, turn=-0.6).model.substeps


def test_an_unknown_displacement_counts_to_its_bounds():
    path = "boundaries.head.sticky.displacement.0"
    truth = {"synthetic": {"truth": {path: 0.02}, "markers": {"a": [0.06, 0.03]}, "every": 1}}
    more = {"job": "sysid", "unknowns": {path: {"bounds": [0.005, 0.1]}}, "data": truth}
    assert bar("yeoh", 0.02, more=more).model.substeps == bar("yeoh", 0.1).model.substeps


def test_a_body_that_becomes_wider_has_no_force_across_it():
    spec = plugins("elastic")["yeoh"](c10=2.5e4, c30=2e4, poissons_ratio=0.3)
    theta = np.array([[getattr(spec, name)] for name in spec.parameters])
    (F,) = pulled([spec.kernel_term(theta)], [theta[:, 0]], 2.9, 2)
    P = nominal([spec.kernel_term(theta)], [theta[:, 0]], F)
    assert F[1, 1] > 1.0
    assert abs(P[1, 1]) < 1e-9 * P[0, 0]


def test_a_strip_has_no_force_across_it_and_a_sheet_keeps_its_width():
    spec = plugins("elastic")["yeoh"](**LAWS["yeoh"])
    theta = np.array([[getattr(spec, name)] for name in spec.parameters])
    terms, thetas = [spec.kernel_term(theta)], [theta[:, 0]]
    strip, sheet = pulled(terms, thetas, 2.0, 3)
    for F in (strip, sheet):
        P = nominal(terms, thetas, F)
        assert abs(P[1, 1]) < 1e-9 * P[0, 0]
    assert strip[1, 1] == strip[2, 2] > 2.0**-0.5
    assert sheet[2, 2] == 1.0
    assert P[0, 0] > 0.0


def test_waves_across_a_grid_that_stays_are_counted_in_its_cells():
    """At rest both are lam + 2 mu; in material that is only turned and stretched alike, they differ by the stretch."""
    spec = plugins("elastic")["neo_hookean"](**LAWS["neo_hookean"])
    theta = np.array([[getattr(spec, name)] for name in spec.parameters])
    terms, thetas = [spec.kernel_term(theta)], [theta[:, 0]]
    for F in (np.eye(2), np.array([[0.0, -1.0], [1.0, 0.0]])):
        for spatial in (False, True):
            stiff = wave_stiffness(terms, thetas, F, spatial=spatial)
            assert stiff == pytest.approx(float(spec.wave_modulus(theta)[0]), rel=1e-3)
    wide = 1.7 * np.eye(2)
    stiff = wave_stiffness(terms, thetas, wide, spatial=True)
    assert stiff == pytest.approx(1.7**2 * wave_stiffness(terms, thetas, wide), rel=1e-9)
