"""Find the least tension with which two fingers hold a disc, and compare their push with the closed answer.

    python -m benchmarks.robots.gripper [--runs DIR] [--out FILE]

The run is `cqrun codesign scenes/robots/gripper_least.yaml`: a gradient search for the least tension with which the
disc slips by no more than 3 mm. The fingers bend, so each touches the disc at an angle t below its equator, with one or
two points of its surface. A finger that is about to slip pushes with the horizontal force

    H = W / 2 (cos t - mu sin t) / (sin t + mu cos t),

which is W / (2 mu) for upright fingers. On one core it takes a quarter of an hour.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.fingerprint import engine_hash
from cqrun.jobs.control import run_codesign
from cqrun.plugin.contract import Array
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json
from cqrun.store.result import LearnedResult, require_result
from cqrun.store.trajectory import read_trajectory

ROOT = Path(__file__).parents[2]
SCENE = ROOT / "scenes" / "robots" / "gripper_least.yaml"
TENSION = "actuators.pull_left.cable.tension"
HELD = 0.3
"""The last part of the run, over which pushes and angles are averaged [s]."""


def compared(run: Path) -> dict[str, Any]:
    """Return the push of a finger at the end of a run, beside the closed answer for the angle at which it touches."""
    scene, motion = load_scene(SCENE), read_trajectory(run / "trajectory.h5")
    disc: Any = scene.rigid["disc"]
    center, radius = np.array(disc.shape.value.center), disc.shape.value.radius
    weight = np.pi * radius**2 * disc.density * -scene.world.gravity[1]
    held = motion.time > motion.time[-1] - HELD
    assert motion.rigid is not None
    assert motion.measured is not None
    grip, slip = (motion.measured.quantities[name].values for name in ("grip", "slip"))
    c, x = center + motion.rigid.part("disc", "displacement")[held], motion.fields["x"]
    t = float(
        np.mean([touching_angle(at, where) for at, where in zip(x[held][:, inner_face(x[0], center)], c, strict=True)])
    )
    closed = 0.5 * weight * (np.cos(t) - disc.friction * np.sin(t)) / (np.sin(t) + disc.friction * np.cos(t))
    push = float(grip[held, 0].mean())
    return {
        "angle_degrees": float(np.degrees(t)), "push_N_m": push, "closed_N_m": float(closed),
        "upright_N_m": float(weight / (2.0 * disc.friction)), "push_over_closed": push / float(closed),
        "slip_mm": 1e3 * float(slip[-1, 1]),
    }  # fmt: skip


def inner_face(x: Array, center: Array) -> Array:
    """Return the particles (n,) on the inner face of the left finger, from below."""
    left = np.flatnonzero(x[:, 0] < center[0])
    face = left[x[left, 0] > x[left, 0].max() - 1e-6]
    return face[np.argsort(x[face, 1])]


def touching_angle(face: Array, c: Array) -> float:
    """Return how far below the equator of a disc at c (2,) the nearest point of a face (n, 2) is [rad].

    Between particles, the distance and the place are parabolas.
    """
    away = np.linalg.norm(face - c, axis=1)
    k = int(np.clip(np.argmin(away), 1, len(away) - 2))
    before, least, after = away[k - 1 : k + 2]
    s = 0.5 * (before - after) / (before - 2.0 * least + after)
    place = face[k] + 0.5 * s * (face[k + 1] - face[k - 1]) + 0.5 * s * s * (face[k + 1] - 2.0 * face[k] + face[k - 1])
    return float(np.arctan2(c[1] - place[1], c[0] - place[0]))


def main() -> None:
    """Run the search, or continue it, and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=Path, default=Path("results") / "gripper")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "gripper.json")
    options = parser.parse_args()
    run = run_codesign(SCENE, [], options.runs)
    result = require_result(run, LearnedResult)
    found = {
        "command": "python -m benchmarks.robots.gripper", "engine": engine_hash(), "status": result.status,
        "iterations": result.iterations, "tension_N_m": result.unknowns[TENSION].value, **compared(run),
    }  # fmt: skip
    write_json(options.out, found)
    print(found)


if __name__ == "__main__":
    main()
