"""Where known beams come to rest: numbers of another program for the same equations, and of the elastica."""

from __future__ import annotations

import pytest
from little_worlds import needs_jit

from benchmarks.convergence.points import Point
from benchmarks.convergence.slender import bend
from benchmarks.rest import AT_REST, LAW, SCENE
from cqrun.build.load_path import inputs_of
from cqrun.build.model import build
from cqrun.engine.reference import rollout
from cqrun.engine.statics.path import RestPath
from cqrun.scene.load import load_scene

pytestmark = needs_jit

SAG = {0.01: -6.0098, 0.005: -6.0466}
"""Cell [m] -> how far the tip of a beam sags without the ghost penalty [mm]: 10 x 3 x 3 cm, E 300 kPa, nu 0.45, 1 g."""


def sag(dx: float, gravity: float) -> float:
    """Return how far the last particles of the beam sag [mm], from the rest shape in one step."""
    changes = [f"world.dx={dx}", f"world.gravity=[0, 0, {gravity}]", f"{LAW}.youngs_modulus=3e5"]
    built = build(load_scene(SCENE, [*AT_REST, *changes]))
    path = RestPath(built.model, [inputs_of(built, {})], tolerance=1e-9, threads=1)
    path.run()
    (point,) = path.points
    assert point.rest.converged
    assert point.halvings == 0
    assert not point.rest.negative
    x = built.particles.x
    end = x[:, 0] > x[:, 0].max() - 1e-9
    return 1e3 * float((path.start.state(point.rest.u).x - x)[end, 2].mean())


@pytest.mark.parametrize("dx", SAG)
def test_a_beam_sags_as_in_another_program(dx, monkeypatch):
    """To all digits without the penalty, which makes it stiffer by less than 0.12 %."""
    monkeypatch.setattr(rollout, "GAMMA", 0.0)
    bare = sag(dx, -9.81)
    assert bare == pytest.approx(SAG[dx], abs=6e-5)
    monkeypatch.undo()
    assert -1.2e-3 < sag(dx, -9.81) / bare - 1.0 < -1e-4


@pytest.mark.parametrize(("dx", "there"), [(0.01, -50.456), (0.005, -50.940)])
def test_ten_times_the_weight_is_found_in_one_step(dx, there):
    """The other program's penalty is larger: at 1 g it makes the beam stiffer by 0.48 and 0.17 %."""
    assert 0.0 < sag(dx, -98.1) / there - 1.0 < 5e-3


@pytest.mark.parametrize(("load", "across", "along"), [(3, 0.0115, 0.021), (10, 0.009, 0.011)])
def test_a_beam_of_four_cells_bends_as_the_elastica(load, across, along):
    found = bend(Point("elastica", "reference", 2, "fixed_corotated", 0.3, f"load {load}", 4, 1))
    assert 0.0 < found["across"] - 1.0 < across
    assert 0.0 < found["along"] - 1.0 < along
