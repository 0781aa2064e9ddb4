"""Bounds on the substep, far beyond what anybody means too."""

from __future__ import annotations

import numpy as np
import pytest

from cqrun.build.limits import motion_limit, wave_limit
from cqrun.build.model import build
from cqrun.errors import SceneError
from cqrun.scene.load import load_scene
from cqrun.scene.unknowns import truths

SCENE = {
    "cqrun": 1,
    "world": {"size": [1, 1], "dx": 0.1, "frame": "updated"},
    "bodies": {
        "a": {
            "shape": {"box": {"corner": [0.2, 0.2], "size": [0.3, 0.3]}},
            "particles_per_cell": 4,
            "material": {
                "density": 1000.0,
                "elastic": {"fixed_corotated": {"youngs_modulus": 1e4, "poissons_ratio": 0.3}},
                "viscosity": {"shear": 1.0},
            },
        }
    },
    "time": {"duration": 0.1, "control_step": 0.01},
}


def limit(viscosity: float, modulus: float = 1e4) -> float:
    """Return the bound of one particle of density 1000 on a grid of .1."""
    return wave_limit("a", 0.1, np.array([1e3]), np.array([modulus]), np.array([viscosity])).dt


def test_waves_without_viscosity_and_all_viscous():
    assert limit(0.0) == pytest.approx(0.1 / np.sqrt(10))
    for viscosity in (1e8, 1e12, 1e20):  # rho dx^2 / (2 eta)
        assert limit(viscosity) == pytest.approx(1e3 * 0.01 / (2 * viscosity), rel=1e-3)


def test_numbers_that_overflow_allow_no_step():
    assert limit(1e308) < 1e-300
    assert limit(0.0, np.inf) == 0.0
    assert motion_limit("a", 0.1, np.full((3, 2), 1e300)).dt == 0.0


@pytest.mark.parametrize("substeps", ["auto", 4])
@pytest.mark.parametrize(
    ("override", "path"),
    [
        ("bodies.a.material.viscosity.bulk=2.2e10", "bodies.a.material"),
        ("bodies.a.material.viscosity.bulk=1e30", "bodies.a.material"),
        ("bodies.a.material.density=1e-100", "bodies.a.material"),
        ("bodies.a.velocity=[1e30, 0]", "bodies.a.velocity"),
    ],
)
def test_a_scene_that_no_substep_suits(override, path, substeps):
    scene = load_scene(SCENE, [override, f"time.substeps={substeps}"])
    with pytest.raises(SceneError, match=rf"{path}: asks for substeps of .* s, more than 1e\+07 in a control step"):
        build(scene)


def test_a_truth_is_run_with_too():
    """A truth beyond the unknown's bounds counts for the substep as they do."""
    E = "bodies.a.material.elastic.fixed_corotated.youngs_modulus"
    scene = SCENE | {
        "unknowns": {E: {"bounds": [5e3, 2e4]}},
        "data": {"synthetic": {"truth": {E: 1e6}, "body": "a", "tracked": 5, "key_frames": 5}},
    }
    softer = build(load_scene(scene, [f"data.synthetic.truth.{E}=1e4"])).model.substeps
    assert build(load_scene(scene)).model.substeps > 5 * softer
    with pytest.raises(SceneError, match="of the largest stable one"):
        build(load_scene(scene, [f"time.substeps={softer}"]))


@pytest.mark.parametrize(("truth", "told"), [(4e3, True), (2e4, False), (2.1e4, True)])
def test_a_truth_that_no_fit_can_find_is_a_warning(truth, told):
    """Also where it is that of what follows an unknown."""
    E = "bodies.a.material.elastic.fixed_corotated.youngs_modulus"
    made = {"truth": {E: truth}, "body": "a", "tracked": 5, "key_frames": 5}
    direct = {E: {"bounds": [5e3, 2e4]}}
    tied = {"bodies.a.material.density": {"bounds": [500, 2000], "also": {E: {"factor": 10}}}}
    for unknowns in (direct, tied):
        warnings = build(load_scene(SCENE | {"unknowns": unknowns, "data": {"synthetic": made}})).warnings
        words = f"truth.{E}: {truth:g} lies outside the unknown's bounds 5000 to 20000: no fit can find it"
        assert any(words in str(warning) for warning in warnings) is told


def test_what_follows_a_truth_is_run_with_too():
    """Unless it has a truth of its own."""
    E, nu = (f"bodies.a.material.elastic.fixed_corotated.{name}" for name in ("youngs_modulus", "poissons_ratio"))
    density = "bodies.a.material.density"
    unknown = {"bounds": [0.1, 0.4], "also": {E: {"factor": 1e5}, density: {"factor": 5e3}}}
    made = {"truth": {nu: 0.2, density: 900.0}, "body": "a", "tracked": 5, "key_frames": 5}
    scene = load_scene(SCENE | {"unknowns": {nu: unknown}, "data": {"synthetic": made}})
    assert truths(scene) == {nu: 0.2, E: pytest.approx(2e4), density: 900.0}
