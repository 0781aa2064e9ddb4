"""Count how often 95 % intervals cover the truth, in fits of scenes/sysid/beam_twin.yaml to many draws of the noise.

    python benchmarks/interval_coverage.py [--draws 50] [--out benchmarks/measured/beam_twin_coverage.json]

A stopped command continues: draws that are in the file are not repeated.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import build
from cqrun.fingerprint import engine_hash
from cqrun.fitting.cases import make_cases
from cqrun.fitting.findings import find_jacobian, list_unknowns
from cqrun.fitting.problem import FitProblem
from cqrun.fitting.uncertainty import intervals
from cqrun.running.threads import cores
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json

SCENE = Path(__file__).parents[1] / "scenes" / "sysid" / "beam_twin.yaml"


class Memory:
    """A session of an optimizer (optimizers/base.py) that writes nothing."""

    seed = 0

    def evaluate(self, kind: str, x: np.ndarray, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
        return compute()

    def restore(self) -> None:
        return None

    def save(self, state: dict[str, np.ndarray]) -> None:
        pass

    def report(self, iteration: int, x: np.ndarray, loss: float, grad: np.ndarray, terms: Mapping[str, float]) -> None:
        pass

    def note(self, text: str) -> None:
        pass

    def should_stop(self) -> bool:
        return False


def draw(seed: int, overrides: list[str]) -> dict[str, Any]:
    """Fit one draw of the noise; return the truth, the value and the interval of every unknown."""
    scene = load_scene(SCENE, [f"data.synthetic.seed={seed}", *overrides])
    assert scene.data is not None
    assert scene.data.synthetic is not None
    assert scene.optimizer is not None
    built = build(scene)
    problem = FitProblem(make_cases(built), make_params(built), threads=cores(None))
    optimizer: Any = scene.optimizer.value
    outcome = optimizer.minimise(problem, Memory())
    unknowns = list_unknowns(problem, outcome.x)
    jacobian = find_jacobian(problem, outcome.x, unknowns)
    uncertainty = intervals(jacobian, problem.residuals(outcome.x), problem.series(), unknowns)
    truth = scene.data.synthetic.truth
    return {
        "seed": seed,
        "status": outcome.status,
        "unknowns": {u.name: [truth[u.name], u.value, uncertainty.intervals[u.name]] for u in unknowns},
    }


def summary(draws: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the share of intervals that cover the truth, for all unknowns and for each."""
    covered: dict[str, list[bool]] = {}
    for entry in draws:
        for name, (truth, _, interval) in entry["unknowns"].items():
            covered.setdefault(name, []).append(interval is not None and interval[0] <= truth <= interval[1])
    every = [hit for hits in covered.values() for hit in hits]
    return {"all": float(np.mean(every)), **{name: float(np.mean(hits)) for name, hits in covered.items()}}


def main() -> None:
    """Fit the draws that are missing, and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/measured/beam_twin_coverage.json"))
    parser.add_argument("-o", dest="overrides", action="append", default=[])
    options = parser.parse_args()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    draws = json.loads(options.out.read_text())["draws"] if options.out.exists() else []
    done = {entry["seed"] for entry in draws}
    for seed in range(options.draws):
        if seed in done:
            continue
        draws.append(draw(seed, options.overrides))
        covered = summary(draws)
        result = {
            "command": "python benchmarks/interval_coverage.py",
            "engine": engine_hash(),
            "covered": covered,
            "draws": draws,
        }
        write_json(options.out, result)
        print(f"{len(draws)}/{options.draws}: {covered['all']:.3f} of the intervals cover the truth", flush=True)


if __name__ == "__main__":
    main()
