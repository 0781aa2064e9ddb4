"""A bar of a law with one branch: its force in a relaxation test, and its stretch in a creep test, as the formulas say.

The bar is in plane strain and keeps its volume, so only its shape counts. With the branch's ratio g and time t, a
force ramp or a stretch at once gives (Christensen, Theory of Viscoelasticity, 1982, chapter 1)

    relaxation:  force / elastic force = 1 + g exp(-s/t),
    creep:       stretch / elastic stretch = 1 - g/(1 + g) exp(-s/((1 + g) t)).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from little_worlds import needs_jit

from cqrun.build.particles import sample
from cqrun.jobs.simulate import run_simulate
from cqrun.scene.load import load_scene
from cqrun.store.trajectory import read_trajectory

pytestmark = needs_jit

RATIO, TIME, RAMP, DURATION = 0.5, 0.25, 0.02, 0.5
LENGTH, WIDTH, DX = 0.04, 0.01, 0.0025
GRIP = {"sticky": {"region": {"half_space": {"point": [0.01, 0.005], "normal": [1.0, 0.0]}}}}
END = {"box": {"corner": [0.005 + LENGTH - DX, 0.005], "size": [DX, WIDTH]}}


def scene(more: dict[str, Any], branch: bool) -> dict[str, Any]:
    """Return a bar with its foot in a grip, and what pulls it."""
    material = {"density": 1000, "elastic": {"neo_hookean": {"youngs_modulus": 1.0e5, "poissons_ratio": 0.4995}}}
    if branch:
        material["prony"] = {"ratio_1": RATIO, "time_1": TIME}
    return {
        "cqrun": 1,
        "world": {"size": [0.06, 0.02], "dx": DX},
        "bodies": {
            "bar": {
                "shape": {"box": {"corner": [0.005, 0.005], "size": [LENGTH, WIDTH]}},
                "particles_per_cell": 4,
                "material": material,
            }
        },
        "boundaries": {"grip": GRIP, **more.get("boundaries", {})},
        "loads": {"air": {"damping": {"rate": 60}}, **more.get("loads", {})},
        "measure": {"force": {"reaction": {"boundary": "grip", "on": "boundary"}}},
        "time": {"duration": DURATION, "control_step": 0.005},
    }


def run(more: dict[str, Any], branch: bool, out: Path) -> Path:
    file = out / f"bar_{branch}.yaml"
    file.write_text(yaml.safe_dump(scene(more, branch)))
    return run_simulate(file, [], out / str(branch), threads=1)


def forces(run: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return times, and the force along the bar."""
    table = np.genfromtxt(run / "measurements.csv", delimiter=",", names=True)
    names = table.dtype.names
    return table[names[0]], table[next(name for name in names if name.startswith("force") and "x" in name)]


def strain(run: Path) -> np.ndarray:
    """Return the strain of the bar's middle over time."""
    rest = sample(load_scene(scene({}, branch=False))).x[:, 0] - 0.005
    middle = (rest > 0.4 * LENGTH) & (rest < 0.7 * LENGTH)
    x = read_trajectory(run / "trajectory.h5").fields["x"][:][..., 0]
    return np.array([np.polyfit(rest[middle], row[middle], 1)[0] - 1.0 for row in x])


def test_the_force_of_a_held_bar_relaxes(tmp_path):
    jaw = {"sticky": {"region": END, "displacement": [2.0e-5, 0.0], "over": RAMP}}
    runs = [run({"boundaries": {"jaw": jaw}}, branch, tmp_path) for branch in (True, False)]
    (time, force), (_, elastic) = (forces(each) for each in runs)
    late = time > 0.15  # the waves have gone
    since = TIME / RAMP * np.expm1(RAMP / TIME) * np.exp(-time / TIME)  # the mean over the ramp
    np.testing.assert_allclose((force / elastic)[late], (1 + RATIO * since)[late], rtol=0.005)
    assert (force / elastic)[late][0] > 1.25


def test_a_bar_under_a_weight_creeps(tmp_path):
    pull = {"point_force": {"body": "bar", "region": END, "force": [0.5, 0.0]}}
    runs = [run({"loads": {"pull": pull}}, branch, tmp_path) for branch in (True, False)]
    creep, elastic = (strain(each) for each in runs)
    time = np.linspace(0.0, DURATION, len(creep))
    late = time > 0.2
    wanted = 1 - RATIO / (1 + RATIO) * np.exp(-time / ((1 + RATIO) * TIME))
    np.testing.assert_allclose((creep / elastic)[late], wanted[late], rtol=0.005)
    assert (creep / elastic)[late][0] < 0.85
