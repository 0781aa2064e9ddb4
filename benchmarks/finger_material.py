"""Fit the finger of CQ2 Fig 5: Young's modulus, Poisson's ratio and density, from its motion with noise and without.

    python benchmarks/finger_material.py [--runs DIR] [--out FILE]

Each fit is a run of `cqrun sysid` below `--runs`. A stopped fit continues, and a finished one is read.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from cqrun.fingerprint import engine_hash
from cqrun.jobs.sysid import run_sysid
from cqrun.store.atomic import write_json
from cqrun.store.result import SysidResult, require_result

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "scenes" / "sysid" / "finger_material.yaml"
FITS: dict[str, list[str]] = {"with noise": [], "without noise": ["data.synthetic.noise=0.0"]}
TRUTH = {"youngs_modulus": 20.0, "poissons_ratio": 0.25, "density": 2.33}
WANTED = {"with noise": 0.03, "without noise": 0.01}
"""The largest relative error that is allowed."""


def fit(name: str, runs: Path) -> dict[str, Any]:
    """Run one fit, or continue it; return what it found."""
    run = run_sysid(SCENE, FITS[name], runs)
    result = require_result(run, SysidResult)
    unknowns = {path: entry.model_dump(include={"value", "interval"}) for path, entry in result.unknowns.items()}
    words = ["cqrun", "sysid", str(SCENE.relative_to(ROOT)), *(f"-o {each}" for each in FITS[name])]
    return {
        "command": " ".join(words),
        "status": result.status,
        "loss": result.loss,
        "unknowns": unknowns,
        "error": worst_error(unknowns),
    }


def worst_error(unknowns: dict[str, Any]) -> float:
    """Return the largest relative error of a value."""
    return max(abs(entry["value"] / TRUTH[path.rpartition(".")[2]] - 1.0) for path, entry in unknowns.items())


def main() -> None:
    """Measure and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=ROOT / "results")
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "finger_material.json")
    given = parser.parse_args()
    fits = {}
    for name in FITS:
        fits[name] = fit(name, given.runs)
        print(f"{name}: worst error {100 * fits[name]['error']:.2f} %", flush=True)
    write_json(given.out, {"command": "python benchmarks/finger_material.py", "engine": engine_hash(), "fits": fits})


if __name__ == "__main__":
    main()
