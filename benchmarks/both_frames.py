"""Train robots of the papers in both frames: what they learn, seconds an iteration, and how far positions drift from F.

    python -m benchmarks.both_frames [--only finger ...] [--runs DIR] [--out FILE]

Each robot is trained as its scene says, and once more with `world.frame: reference` and as many substeps as that frame
needs. A stopped run continues, and a finished one is read.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.engine.frames import FRAMES
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import machine
from cqrun.jobs.control import run_codesign, run_control
from cqrun.jobs.simulate import run_simulate
from cqrun.store.atomic import write_json
from cqrun.store.history import read_history

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
        "drift of positions from F": drift_of(run, runs / f"{name}_{frame}_replay"),
    }


def drift_of(run: Path, out: Path) -> str:
    """Return what a replay of a run's motion finds about its drift; it says nothing of a drift below 1 %."""
    replay = json.loads((run_simulate(run, [], out) / "result.json").read_text())
    return next((finding for finding in replay["findings"] if "deformation gradient" in finding), "below 1 %")


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
