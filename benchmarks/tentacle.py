"""Fit Young's moduli of the silicone tentacle, and the friction of its guides, to eight poses at rest, on two grids.

    python benchmarks/tentacle.py --recordings DIR [--only coarse fine ...] [--runs DIR] [--out FILE]

DIR holds the recordings (tud-phi/soromox, MIT licence) as poses.csv, one line for each marker and pose, as the header
of scenes/sysid/tentacle.yaml says. Each fit is a run of `cqrun sysid` below `--runs`. A stopped fit continues, and a
finished one is read. On one core of a busy machine the coarse grid takes half an hour, and the fine one more than an
hour; half of it are the intervals. `one_modulus` has one modulus for the whole arm.
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import machine
from cqrun.jobs.sysid import run_sysid
from cqrun.store.atomic import write_json
from cqrun.store.result import SysidResult, require_result

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "scenes" / "sysid" / "tentacle.yaml"
MODULUS = "bodies.arm.material.elastic.fixed_corotated.youngs_modulus"
NEAR = [
    f"{MODULUS}=3.9e5",
    "actuators.one.cable.friction=0.01",
    "actuators.two.cable.friction=0.01",
    "data.recordings.poses.offset=[0.036, 0.036, 0.3836]",
    "data.recordings.poses.rotation=[0.0227, -0.0046, -0.04]",
]
"""Near the coarse grid's answer."""

FITS: dict[str, list[str]] = {
    "one_modulus": [f"unknowns.{MODULUS}.per=body"],
    "coarse": [],
    "fine": ["world.dx=0.0045", *NEAR],
}
"""Name -> overrides: two grids, the finer one from near the other's answer."""

ROD_MODEL_MM = 15.8
"""Mean marker error over 22 poses of the rod model that comes with the recordings, fitted to these eight."""


def fit(name: str, poses: Path, runs: Path) -> dict[str, Any]:
    """Run one fit, or continue it; return what it found."""
    run = run_sysid(SCENE, [f"data.recordings.poses.file={poses}", *FITS[name]], runs / name)
    result = require_result(run, SysidResult)
    facts = json.loads((run / "run.json").read_text())
    words = [word for override in FITS[name] for word in ("-o", override)]
    return {
        "command": shlex.join(["cqrun", "sysid", "scenes/sysid/tentacle.yaml", *words]),
        "engine": facts["engine"],
        **result.model_dump(include={"status", "iterations", "unknowns", "recordings", "findings"}),
        "minutes": seconds(run) / 60,
    }


def seconds(run: Path) -> float:
    """Return the time that the iterations of a run took [s]."""
    last = (run / "history.csv").read_text().splitlines()[-1]
    head = (run / "history.csv").read_text().splitlines()[0].split(",")
    return float(last.split(",")[head.index("seconds")])


def main() -> None:
    """Run the fits, and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=Path, required=True)
    parser.add_argument("--only", nargs="+", choices=list(FITS), default=list(FITS))
    parser.add_argument("--runs", type=Path, default=Path("results") / "tentacle")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "tentacle.json")
    options = parser.parse_args()
    options.runs.mkdir(parents=True, exist_ok=True)
    poses = options.runs.resolve() / "poses.csv"
    shutil.copyfile(options.recordings / "poses.csv", poses)
    result = json.loads(options.out.read_text()) if options.out.exists() else {}
    for name in options.only:
        result[name] = fit(name, poses, options.runs)
        source = {"command": "python benchmarks/tentacle.py --recordings DIR", "machine": machine()}
        write_json(options.out, {**result, **source, "engine": engine_hash(), "rod_model_mm": ROD_MODEL_MM})
        young = ", ".join(f"{value / 1e3:.1f}" for value in np.atleast_1d(result[name]["unknowns"][MODULUS]["value"]))
        print(f"{name}: E {young} kPa, {result[name]['recordings']['poses']['mean_mm']:.2f} mm", flush=True)


if __name__ == "__main__":
    main()
