"""Find the density in CQ1's collision task for ten samplings of the balls and two substeps, beside a scan.

    python -m benchmarks.collision_seeds

The paper reports 2.26 for one sampling of unknown seed. The gradient's optimum is compared with a scan of the loss:
41 densities, then a bracketed search between the neighbours of the best one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from benchmarks.interval_coverage import Memory
from cqrun.build.model import build
from cqrun.fingerprint import engine_hash
from cqrun.fitting.cases import make_cases
from cqrun.fitting.problem import FitProblem
from cqrun.running.unknowns import make_params
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "scenes" / "sysid" / "collision.yaml"
OUT = ROOT / "benchmarks" / "measured" / "collision_seeds.json"
UNKNOWN = "bodies.a.material.density"


def problem_of(seed: int, substeps: int) -> tuple[FitProblem, Any]:
    """Return the fit problem of one sampling, and the scene's optimizer."""
    seeds = [f"bodies.{body}.sampling.random.seed={2 * seed + k}" for k, body in enumerate("ab")]
    scene = load_scene(SCENE, [*seeds, f"time.substeps={substeps}"])
    assert scene.optimizer is not None
    built = build(scene)
    return FitProblem(make_cases(built), make_params(built)), scene.optimizer.value


def by_gradient(seed: int, substeps: int) -> float:
    """Return the density at the optimum that the scene's optimizer finds."""
    problem, optimizer = problem_of(seed, substeps)
    return float(problem.values(optimizer.minimise(problem, Memory()).x)[UNKNOWN])


def by_scan(seed: int, substeps: int) -> float:
    """Return the density with the least loss, from forward runs alone."""
    problem, _ = problem_of(seed, substeps)
    case = problem.cases[0]

    def loss(density: float) -> float:
        values = {UNKNOWN: np.array(density)}
        return float(case.losses(case.run(values), values)[0])

    densities = np.linspace(1.0, 5.0, 41)
    best = int(np.argmin([loss(density) for density in densities]))
    bracket = (densities[max(best - 1, 0)], densities[min(best + 1, 40)])
    return float(minimize_scalar(loss, bounds=bracket, method="bounded", options={"xatol": 1e-6}).x)


def main() -> None:
    """Measure and write the file."""
    rows = []
    for seed in range(10):
        rows.append(
            {
                "seed": seed,
                "gradient": by_gradient(seed, 10),
                "scan": by_scan(seed, 10),
                "half_step": by_gradient(seed, 20),
            }
        )
        print(rows[-1], flush=True)
    found, half = (np.array([row[key] for row in rows]) for key in ("gradient", "half_step"))
    worst = max(abs(row["gradient"] / row["scan"] - 1.0) for row in rows)
    summary = {
        "paper": 2.26, "mean": found.mean(), "sd": found.std(ddof=1), "least": found.min(), "greatest": found.max(),
        "mean_at_half_the_substep": half.mean(), "worst_difference_from_scan": worst,
    }  # fmt: skip
    write_json(
        OUT,
        {"command": "python -m benchmarks.collision_seeds", "engine": engine_hash(), "summary": summary, "rows": rows},
    )
    print(summary)


if __name__ == "__main__":
    main()
