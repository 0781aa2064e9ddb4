"""A bar of each law of rubber, pulled to 200 % nominal strain, and a sheet to 100 %: the force of the law's formula.

In 3D the bar is free at its sides (uniaxial tension), in 2D it keeps its width across the plane (planar tension). Its
foot is in a grip, and its stretch is measured in its middle, as an extensometer does. The sheet is a quarter of one
that is pulled at its four sides (equibiaxial tension): its other two sides slip on planes of symmetry.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from little_worlds import needs_jit

from cqrun.build.particles import sample
from cqrun.jobs.rest import REST
from cqrun.materials.curves import nominal_stress
from cqrun.plugin.registry import plugins
from cqrun.scene.load import load_scene
from cqrun.store.trajectory import read_trajectory

pytestmark = needs_jit

LAWS: dict[str, dict[str, float]] = {
    "neo_hookean": {"youngs_modulus": 1.0e5},
    "mooney_rivlin": {"c10": 1.3e4, "c01": 3.0e3},
    "yeoh": {"c10": 1.6e4, "c20": -300.0, "c30": 90.0},
    "gent": {"mu": 3.2e4, "jm": 25.0},
    "arruda_boyce": {"mu": 3.0e4, "lock": 3.0},
    "ogden": {"mu_1": 2.0e4, "alpha_1": 2.4, "mu_2": 40.0, "alpha_2": 5.0, "mu_3": -500.0, "alpha_3": -2.0},
}
RATIO, STRETCH, LENGTH, WIDTH, DX = 0.4999, 3.0, 0.06, 0.01, 0.0025


def scene(dim: int, name: str, force: float) -> dict[str, Any]:
    """Return a bar along x with a foot in a grip, pulled at its far end."""
    corner, size = [0.005] * dim, [LENGTH, *[WIDTH] * (dim - 1)]
    end = {"box": {"corner": [corner[0] + LENGTH - DX, *corner[1:]], "size": [DX, *size[1:]]}}
    foot = [corner[0] + 2 * DX, *corner[1:]]
    law = LAWS[name] | {"poissons_ratio": RATIO}
    pull = {"body": "bar", "region": end, "force": [0.0] * dim}
    return {
        "cqrun": 1,
        "job": "rest",
        "world": {"size": [0.22, *[0.02] * (dim - 1)], "dx": DX},
        "bodies": {
            "bar": {
                "shape": {"box": {"corner": corner, "size": size}},
                "particles_per_cell": 2**dim,
                "material": {"density": 1000, "elastic": {name: law}},
            }
        },
        "boundaries": {
            "grip": {"sticky": {"region": {"half_space": {"point": foot, "normal": [1.0, *[0.0] * (dim - 1)]}}}}
        },
        "loads": {"pull": {"point_force": pull}},
        "path": {"loads.pull.point_force.force.0": {"first": force / 8, "last": force, "points": 8}},
    }


SIDE, THICK, CORNER, STRIP = 0.03, 0.005, 0.005, 0.5 * DX


def sheet(name: str, stress: float) -> dict[str, Any]:
    """Return a quarter of a square sheet across z, pulled at two sides with a force per area at rest."""
    force, loads, path, planes = stress * SIDE * THICK, {}, {}, {}
    for axis in (0, 1):
        corner, size = [CORNER] * 3, [SIDE, SIDE, THICK]
        corner[axis], size[axis] = CORNER + SIDE - STRIP, STRIP
        region = {"box": {"corner": corner, "size": size}}
        loads[f"pull_{axis}"] = {"point_force": {"body": "sheet", "region": region, "force": [0.0, 0.0, 0.0]}}
        path[f"loads.pull_{axis}.point_force.force.{axis}"] = {"first": force / 4, "last": force, "points": 4}
        plane = {"point": [CORNER] * 3, "normal": [float(axis == k) for k in range(3)]}
        planes[f"plane_{axis}"] = {"slip": {"region": {"half_space": plane}}}
    planes["pin"] = {"sticky": {"region": {"box": {"corner": [0, 0, CORNER + DX], "size": [CORNER, CORNER, 1e-4]}}}}
    return {
        "cqrun": 1,
        "job": "rest",
        "world": {"size": [0.2, 0.2, 0.02], "dx": DX},
        "bodies": {
            "sheet": {
                "shape": {"box": {"corner": [CORNER] * 3, "size": [SIDE, SIDE, THICK]}},
                "particles_per_cell": 8,
                "material": {"density": 1000, "elastic": {name: LAWS[name] | {"poissons_ratio": RATIO}}},
            }
        },
        "boundaries": planes,
        "loads": loads,
        "path": path,
    }


CASES = [
    pytest.param(dim, name, id=f"{mode} {name}", marks=[] if (dim, name) == (2, "yeoh") else pytest.mark.slow)
    for dim, mode in ((2, "planar"), (3, "uniaxial"))
    for name in LAWS
]
"""Every law has kernels of its own, which take half a minute to compile."""


@pytest.mark.parametrize(("dim", "name"), CASES)
def test_the_force_at_200_percent_is_that_of_the_law(name, dim, tmp_path):
    spec = plugins("elastic")[name](**LAWS[name], poissons_ratio=RATIO)
    theta = np.array([getattr(spec, parameter) for parameter in spec.parameters])
    mode = "planar" if dim == 2 else "uniaxial"
    wanted = float(nominal_stress(spec, theta, mode, np.array([STRETCH]))[0])
    loaded = load_scene(scene(dim, name, wanted * WIDTH ** (dim - 1)))
    rest = sample(loaded).x[:, 0] - 0.005
    x = read_trajectory(REST.start("bar", loaded, tmp_path) / "trajectory.h5").fields["x"][-1][:, 0]
    middle = (rest > 0.4 * LENGTH) & (rest < 0.7 * LENGTH)
    stretch = np.polyfit(rest[middle], x[middle], 1)[0]
    found = float(nominal_stress(spec, theta, mode, np.array([stretch]))[0])
    assert found == pytest.approx(wanted, rel=0.01)


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) for name in LAWS])
def test_the_force_on_a_sheet_at_100_percent_is_that_of_the_law(name, tmp_path):
    spec = plugins("elastic")[name](**LAWS[name], poissons_ratio=RATIO)
    theta = np.array([getattr(spec, parameter) for parameter in spec.parameters])
    wanted = float(nominal_stress(spec, theta, "equibiaxial", np.array([2.0]))[0])
    loaded = load_scene(sheet(name, wanted))
    rest = sample(loaded).x - CORNER
    x = read_trajectory(REST.start("sheet", loaded, tmp_path) / "trajectory.h5").fields["x"][-1]
    middle = (rest[:, :2].min(axis=1) > 0.2 * SIDE) & (rest[:, :2].max(axis=1) < 0.7 * SIDE)
    for axis in (0, 1):
        stretch = np.polyfit(rest[middle, axis], x[middle, axis], 1)[0]
        found = float(nominal_stress(spec, theta, "equibiaxial", np.array([stretch]))[0])
        assert found == pytest.approx(wanted, rel=0.01)
