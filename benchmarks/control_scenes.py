"""What the robots of both papers learn at their papers' sizes: every scene of scenes/control, seed by seed.

    python benchmarks/control_scenes.py [--only NAME ...] [--runs DIR] [--minutes 140] [--jobs 2]
    python benchmarks/control_scenes.py --speed [--only NAME ...] [--runs DIR]

An experiment is `cqrun control SCENE --seeds N` with the overrides below. It is stopped when its time is over, and
the same command goes on with it; what is finished is read. Each leaves measured/control/NAME.json (every seed, mean
and 90 % interval, iterations to the thresholds, seconds an iteration: on one core where seeds run side by side) and
NAME.csv (the measure against the iteration, a column a seed). `--speed` times three iterations of each scene alone on
all cores instead, into measured/control/speed.json.
"""

from __future__ import annotations

import argparse
import csv
import io
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import machine
from cqrun.jobs.control import run_control
from cqrun.jobs.seeds import CONFIDENCE, interval
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json, write_text
from cqrun.store.run import read_record

ROOT = Path(__file__).parents[1]
SCENES = ROOT / "scenes" / "control"
EXIT_STOPPED = 75


@dataclass(frozen=True)
class Experiment:
    """A scene, what is measured of it, and what its paper says.

    Attributes:
        scene: in scenes/control.
        term: of the objective; squared distances are measured as distances.
        overrides: of the scene.
        seeds: how many.
        thresholds: of a distance to a goal: how many iterations until it is below.
        window: iterations over which the measure is averaged first, as the paper does.
        paper: its figures, by name.
    """

    scene: str
    term: str
    overrides: tuple[str, ...] = ()
    seeds: int = 1
    thresholds: tuple[float, ...] = ()
    window: int = 1
    paper: dict[str, Any] = field(default_factory=dict)

    @property
    def is_gap(self) -> bool:
        """Whether the measure is a distance to a goal, to be made small."""
        return self.term in ("tip", "head")


def _cables(stiffness: float) -> tuple[str, ...]:
    names = ("back_left", "back_right", "front_left", "front_right")
    return tuple(f"actuators.{name}.cable.stiffness={stiffness:g}" for name in names)


def _pressure(value: float) -> tuple[str, ...]:
    return (f"actuators.leg.pneumatic.max_pressure={value:g}",)


RANDOM = {"below": {"0.01": 132, "0.005": 203}}
WIDE = {"below": {"0.015": 282, "0.01": 438}}
CABLE = {"distance": 0.58, "interval": [0.47, 0.80], "seconds": 12}
RHINO = {"distance": 0.85, "interval": [0.64, 1.07], "seconds": 21}
CREATURE = {"distance": 0.27, "interval": [0.06, 0.50], "seconds": 38}
TERRAIN = {"distance": 1.61, "interval": [1.50, 1.72], "seconds": 20}
SMALL = ("bodies.biped.sampling.lattice.count=20", "bodies.terrain.spacing=0.006", "time.substeps=20")

EXPERIMENTS = {
    "finger": Experiment("finger", "tip", seeds=10, thresholds=(0.02, 0.01), paper={"below": {"0.02": 21, "0.01": 31}}),
    "finger_random": Experiment("finger_random", "tip", (), 10, (0.01, 0.005), 100, RANDOM),
    "finger_wide": Experiment("finger_wide", "tip", (), 10, (0.015, 0.01), 100, WIDE),
    "biped": Experiment("biped", "far", seeds=10),
    "arm_reach_3d": Experiment("arm_reach_3d", "tip"),
    "crawler": Experiment("crawler", "head", thresholds=(0.15,)),
    "quadruped": Experiment("quadruped", "head", thresholds=(0.15,)),
    "biped_cable": Experiment("biped_cable", "far", seeds=10, paper=CABLE),
    "biped_cable_half": Experiment("biped_cable", "far", _cables(2.15e5), 10, paper=CABLE),
    "biped_cable_double": Experiment("biped_cable", "far", _cables(8.6e5), 10, paper=CABLE),
    "rhino": Experiment("rhino", "far", seeds=3, paper=RHINO),
    "creature": Experiment("creature", "far", seeds=3, paper=CREATURE),
    "biped_terrain": Experiment("biped_terrain", "far", paper=TERRAIN),
    "biped_terrain_small": Experiment("biped_terrain", "far", SMALL, seeds=5, paper=TERRAIN),
}
"""In the order in which they are run: the short ones first."""


def learn(name: str, runs: Path, seconds: float, jobs: int) -> bool:
    """Run an experiment or go on with it, for so long; say whether it is finished."""
    it = EXPERIMENTS[name]
    command = [sys.executable, "-m", "cqrun", "control", str(SCENES / f"{it.scene}.yaml"), "--quiet"]
    command += ["--seeds", str(it.seeds), "--jobs", str(min(jobs, it.seeds)), "--out", str(runs / name)]
    command += [word for override in it.overrides for word in ("-o", override)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        code = process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGTERM)
        code = process.wait()
    if code not in (0, EXIT_STOPPED):
        raise SystemExit(f"{name}: `{' '.join(command)}` ended with {code}")
    return code == 0


def histories(name: str, runs: Path) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return, by seed, the measure at every iteration and its wall time since the run began [s]."""
    it, found = EXPERIMENTS[name], {}
    for history in (runs / name / it.scene).glob("*/history.csv"):
        rows = list(csv.DictReader(history.open()))
        value, seconds = (np.array([float(row[key]) for row in rows]) for key in (it.term, "seconds"))
        found[int(read_record(history.parent)["seed"])] = (np.sqrt(value) if it.is_gap else value, seconds)
    return dict(sorted(found.items()))


def smooth(value: np.ndarray, window: int) -> np.ndarray:
    """Return means over the last `window` iterations, or over as many as there are."""
    total = np.cumsum(np.concatenate([[0.0], value]))
    k = np.arange(1, len(value) + 1)
    first = np.maximum(0, k - window)
    return (total[k] - total[first]) / (k - first)


def first_below(value: np.ndarray, threshold: float) -> int | None:
    """Return the first iteration at which a measure is below a threshold."""
    below = np.flatnonzero(value < threshold)
    return int(below[0]) if len(below) else None


def summary(name: str, found: dict[int, tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """Return what an experiment has shown so far."""
    it = EXPERIMENTS[name]
    best = min if it.is_gap else max
    seeds: dict[str, dict[str, Any]] = {}
    for seed, (value, seconds) in found.items():
        curve = smooth(value, it.window)
        seeds[str(seed)] = {
            "iterations": len(value) - 1,
            "start": float(value[0]),
            "best": float(best(curve[min(it.window, len(curve)) - 1 :])),
            "last": float(curve[-1]),
            **{f"below {threshold:g}": first_below(curve, threshold) for threshold in it.thresholds},
            "seconds_an_iteration": float(np.median(np.diff(seconds))) if len(seconds) > 1 else None,
        }
    overrides = " ".join(f"-o {override}" for override in it.overrides)
    return {
        "command": f"cqrun control scenes/control/{it.scene}.yaml --seeds {it.seeds} {overrides}".strip(),
        "engine": engine_hash(),
        "machine": machine(),
        "paper": it.paper,
        "confidence": CONFIDENCE,
        **{key: interval([entry[key] for entry in seeds.values()]) for key in ("start", "best", "last")},
        "seeds": seeds,
    }


def table(found: dict[int, tuple[np.ndarray, np.ndarray]]) -> str:
    """Return CSV: iteration, and the measure of each seed."""
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["iteration", *(f"seed {seed}" for seed in found)])
    for k in range(max(len(value) for value, _ in found.values())):
        rows.writerow([k, *(f"{value[k]:.6g}" if k < len(value) else "" for value, _ in found.values())])
    return text.getvalue()


def speed(name: str, runs: Path) -> dict[str, Any]:
    """Return what an iteration of a scene takes when it has all cores [s], the median of three."""
    it = EXPERIMENTS[name]
    scene = load_scene(SCENES / f"{it.scene}.yaml")
    assert scene.optimizer is not None
    short = [f"optimizer.{scene.optimizer.name}.max_iterations=3"]
    run = run_control(SCENES / f"{it.scene}.yaml", short, runs / "speed", True, None, True)
    seconds = [float(row["seconds"]) for row in csv.DictReader((run / "history.csv").open())]
    return {"seconds": float(np.median(np.diff(seconds))), "paper": it.paper.get("seconds"), "machine": machine()}


def main() -> None:
    """Run experiments for as long as there is time, and write what each has shown."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(EXPERIMENTS), default=list(EXPERIMENTS))
    parser.add_argument("--runs", type=Path, default=Path("results") / "control_scenes")
    parser.add_argument("--minutes", type=float, default=140.0)
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "control")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.speed:
        names = [name for name in options.only if EXPERIMENTS[name].scene == name]
        write_json(options.out / "speed.json", {name: speed(name, options.runs) for name in names})
        return
    end = time.monotonic() + 60.0 * options.minutes
    for name in options.only:
        finished = learn(name, options.runs, max(1.0, end - time.monotonic()), options.jobs)
        if found := histories(name, options.runs):
            result = {"finished": finished} | summary(name, found)
            write_json(options.out / f"{name}.json", result)
            write_text(options.out / f"{name}.csv", table(found))
            print(f"{name}: best {result['best']}, last {result['last']}", flush=True)
        if not finished:
            raise SystemExit("out of time: the same command goes on")


if __name__ == "__main__":
    main()
