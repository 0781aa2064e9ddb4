"""Hollow bodies under inner pressure, from scenes with a `chamber`, against closed forms.

The closed forms are in benchmarks/convergence/vessels.py. How far the inner surface has moved is told by the chamber's
volume, V / V0 = (r / R)^D.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit

from benchmarks.convergence.vessels import Vessel, closed_tube
from cqrun.jobs.rest import REST
from cqrun.scene.load import load_scene
from cqrun.store.result import RestResult, require_result
from cqrun.store.trajectory import read_trajectory

pytestmark = needs_jit

INNER, OUTER, E = 0.02, 0.04, 1.0e5


def vessel(
    dim: int, cells: int, nu: float, supply: dict[str, Any], path: dict[str, Any], **world: Any
) -> dict[str, Any]:
    """Return a hollow ball (2D: disc), with `cells` across its wall, with planes of symmetry."""
    dx = (OUTER - INNER) / cells
    middle = [OUTER + 3 * dx] * dim
    ball = lambda radius: {"ball": {"center": middle, "radius": radius}}  # noqa: E731
    sides = ["x", "y", "z"][:dim]
    return {
        "cqrun": 1,
        "job": "rest",
        "world": {"size": [2 * middle[0]] * dim, "dx": dx, "frame": "reference", **world},
        "bodies": {
            "vessel": {
                "shape": {"difference": [ball(OUTER), ball(INNER)]},
                "spacing": dx / 2,
                "sampling": {"lattice": {"fitted": True}},
                "material": {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": E, "poissons_ratio": nu}}},
            }
        },
        "boundaries": {side: {"slip": plane(k, middle, dx)} for k, side in enumerate(sides)},
        "actuators": {"air": {"chamber": {"body": "vessel", **supply}}},
        "activation": {"signals": {"air": [1]}},
        "measure": {
            "volume": {"chamber_volume": {"chamber": "air"}},
            "pressure": {"chamber_pressure": {"chamber": "air"}},
        },
        "path": path,
    }


def plane(axis: int, middle: list[float], dx: float) -> dict[str, Any]:
    """Return a plane of symmetry: the nodes in the middle do not move along an axis."""
    corner, size, normal = [0.0] * len(middle), [2 * c for c in middle], [0.0] * len(middle)
    corner[axis], size[axis], normal[axis] = middle[axis] - 0.25 * dx, 0.5 * dx, 1.0
    return {"region": {"box": {"corner": corner, "size": size}}, "normal": normal}


def measured(scene: dict[str, Any], folder: Any) -> tuple[np.ndarray, np.ndarray, RestResult]:
    """Return (V / V0)^(1/D) and the pressure [Pa] at each point of a scene's path, and the result."""
    run = REST.start("vessel", load_scene(scene), folder)
    found = read_trajectory(run / "trajectory.h5").measured
    assert found is not None
    volume, pressure = (found.quantities[name].values[:, 0] for name in ("volume", "pressure"))
    return (volume / volume[0]) ** (1 / len(scene["world"]["size"])), pressure, require_result(run, RestResult)


@pytest.mark.parametrize("nu", [0.3, 0.45])
@pytest.mark.parametrize(("dim", "cells"), [(2, 4), (2, 8), (3, 4)])
def test_lame(dim, cells, nu, tmp_path):
    """Under a thousandth of E the inner surface moves as Lame says, within 2 %."""
    pressure = 1e-3 * E
    stretch, _, _ = measured(vessel(dim, cells, nu, {"pressure": pressure}, {}), tmp_path)
    expected = Vessel(dim, INNER, OUTER, E, nu).small(pressure)
    assert stretch[-1] - 1.0 == pytest.approx(expected - 1.0, rel=0.02)


@pytest.mark.parametrize(("dim", "cells"), [(2, 4), (2, 8)])
def test_large_stretches(dim, cells, tmp_path):
    """Rubber: up to 1.5 times the inner radius, the pressure is that of the closed form within 2 %."""
    exact = Vessel(dim, INNER, OUTER, E, 0.5)
    most = exact.pressure(1.5)
    path = {"actuators.air.chamber.pressure": {"first": most / 8, "last": most, "points": 8}}
    scene = vessel(dim, cells, 0.4999, {"pressure": most}, path, volume="averaged")
    stretch, pressure, _ = measured(scene, tmp_path)
    assert stretch[-1] > 1.4
    for s, p in zip(stretch[1:], pressure[1:], strict=True):
        assert p == pytest.approx(exact.pressure(float(s)), rel=0.02)


@pytest.mark.slow
def test_beyond_the_limit_there_is_no_equilibrium(tmp_path):
    """A regulator that asks for more than a balloon can hold is told so, with the pressure that was reached."""
    _, highest = Vessel(3, INNER, OUTER, E, 0.5).limit()
    path = {"actuators.air.chamber.pressure": [0.8 * highest, 1.2 * highest]}
    scene = vessel(3, 4, 0.49, {"pressure": highest}, path, volume="averaged")
    result = require_result(REST.start("vessel", load_scene(scene), tmp_path), RestResult)
    assert [point.converged for point in result.points] == [True, False]
    assert "chamber 'air'" in " ".join([result.message, *result.findings])


@pytest.mark.slow
def test_a_closed_tube_becomes_longer(tmp_path):
    """A long straight tube with ends, 4 cells across its wall: its middle stretches as Lame says, within 2 %."""
    inner, outer, dx, nu, pressure = 0.004, 0.008, 0.001, 0.3, 200.0
    middle, ends = [0.011, 0.011], (0.004, 0.056)
    rod = lambda radius, low, high: {  # noqa: E731
        "cylinder": {"start": [low, *middle], "end": [high, *middle], "radius": radius}
    }
    slab = lambda x: {"box": {"corner": [x, 0, 0], "size": [2 * dx, 0.022, 0.022]}}  # noqa: E731
    scene = {
        "cqrun": 1,
        "job": "rest",
        "world": {"size": [0.064, 0.022, 0.022], "dx": dx, "frame": "reference"},
        "bodies": {
            "tube": {
                "shape": {"difference": [rod(outer, *ends), rod(inner, ends[0] + 0.004, ends[1] - 0.004)]},
                "spacing": dx / 2,
                "sampling": {"lattice": {"fitted": True}},
                "groups": {"left": slab(0.022), "right": slab(0.038)},
                "material": {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": E, "poissons_ratio": nu}}},
            }
        },
        "boundaries": {
            "x": {"slip": plane(0, [0.03, *middle], dx)},
            "y": {"slip": plane(1, [0.03, *middle], dx)},
            "z": {"slip": plane(2, [0.03, *middle], dx)},
        },
        "actuators": {"air": {"chamber": {"body": "tube", "pressure": pressure}}},
        "activation": {"signals": {"air": [1]}},
        "measure": {"length": {"distance": {"body": "tube", "group": "left", "to_group": "right"}}},
    }
    run = REST.start("tube", load_scene(scene), tmp_path)
    found = read_trajectory(run / "trajectory.h5").measured
    assert found is not None
    length = found.quantities["length"].values[:, 0]
    assert length[-1] / length[0] - 1.0 == pytest.approx(closed_tube(inner, outer, E, nu, pressure), rel=0.02)
