"""Train robots of the papers in both frames: what they learn, seconds an iteration, and how far positions drift from F.

    python -m benchmarks.both_frames [--only finger ...] [--runs DIR] [--out FILE]

Each robot is trained as its scene says, and once more with `world.frame: reference` and as many substeps as that frame
needs. A stopped run continues, and a finished one is read.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import build
from cqrun.engine.frames import FRAMES
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import machine
from cqrun.jobs.control import run_codesign, run_control
from cqrun.running.drift import drift
from cqrun.running.observables import fracture_of
from cqrun.scene.load import load_scene
from cqrun.state import State
from cqrun.store.atomic import write_json
from cqrun.store.history import read_history
from cqrun.store.trajectory import read_trajectory

ROOT = Path(__file__).parents[1]
SCENES = {"finger": "control/finger", "arm_two_link": "codesign/arm_two_link", "biped": "control/biped"}
IN_THE_OTHER_FRAME = ["world.frame=reference", "time.substeps=auto"]


def train(name: str, frame: str, runs: Path) -> dict[str, Any]:
    """Train one robot in one frame, or continue; return what came of it."""
    scene = ROOT / "scenes" / f"{SCENES[name]}.yaml"
    job = run_control if SCENES[name].startswith("control") else run_codesign
    overrides = IN_THE_OTHER_FRAME if frame == "reference" else []
    run = job(scene, overrides, runs / f"{name}_{frame}")
    result = json.loads((run / "result.json").read_text())
    history = read_history(run / "history.csv")
    seconds = np.diff(history["seconds"])
    return {
        "status": result["status"],
        "iterations": result["iterations"],
        "substeps": result["substeps"],
        "loss at start": result["start"]["loss"],
        "loss": result["trained"]["loss"],
        "terms": result["trained"]["terms"],
        "constraints": result["constraints"],
        "median seconds an iteration": round(float(np.median(seconds)), 3),
        "drift of positions from F [%]": round(100.0 * drift_of(scene, overrides, run), 3),
    }


def drift_of(scene: Path, overrides: list[str], run: Path) -> float:
    """Return the largest drift of a body at the end of a run's trajectory."""
    built = build(load_scene(scene, overrides))
    neighbours = fracture_of(replace(built, model=replace(built.model, frame="updated"))).pairs
    fields = {key: values[-1] for key, values in read_trajectory(run / "trajectory.h5").fields.items()}
    n, dim = fields["x"].shape
    last = State(fields["x"], np.zeros((n, dim)), np.zeros((n, dim, dim)), fields["F"], np.zeros(0))
    return max(abs(drift(pairs, built.particles.x, last)) for pairs in neighbours.values())


def main() -> None:
    """Train the robots, and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(SCENES), default=list(SCENES))
    parser.add_argument("--runs", type=Path, default=Path("results") / "both_frames")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "both_frames.json")
    options = parser.parse_args()
    found = json.loads(options.out.read_text()) if options.out.exists() else {}
    for name in options.only:
        for frame in FRAMES:
            found.setdefault(name, {})[frame] = train(name, frame, options.runs)
            write_json(options.out, {**found, "machine": machine(), "engine": engine_hash()})
            print(f"{name}, {frame}: {found[name][frame]}", flush=True)


if __name__ == "__main__":
    main()
