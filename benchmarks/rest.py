"""Measure how long the real beam takes to come to rest, and its gradient: two grids, nu 0.45 and nearly 0.5.

    python benchmarks/rest.py [--threads N] [--repeat N] [--only beam beam_fine ...] [--out FILE]

The beam is that of scenes/sysid/real_beam_rest.yaml under its own weight, at 1e-8. The gradient is that of the
height of its tip by Young's modulus. Each takes the fastest of a few repetitions, after one that compiles. Wall-clock
times count, so the machine should be quiet; the CPU time beside each tells whether it was.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from cqrun.build.load_path import gradient_of, inputs_of
from cqrun.build.model import Built, build
from cqrun.engine.model import Records
from cqrun.engine.statics.path import RestPath
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import machine
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "scenes" / "sysid" / "real_beam_rest.yaml"
LAW = "bodies.beam.material.elastic.fixed_corotated"
MODULUS = 2.7e5
AT_REST = [
    "job=null", "data=null", "unknowns=null", "optimizer=null", "world.frame=reference",
    "boundaries.clamp.sticky.region.box.size.0=0.04", f"{LAW}.youngs_modulus={MODULUS!r}",
]  # fmt: skip
"""The beam alone, 100 mm long."""

STIFF = [f"{LAW}.poissons_ratio=0.499", "world.volume=averaged"]
FINE = ["world.dx=0.0025"]
CASES: dict[str, list[str]] = {
    "beam": [],
    "beam_fine": FINE,
    "beam_incompressible": STIFF,
    "beam_fine_incompressible": [*FINE, *STIFF],
}
"""Name -> overrides."""


def timed(work: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """Return what `work` returns, and its time."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, {"seconds": time.perf_counter() - wall, "cpu_seconds": time.process_time() - cpu}


def once(built: Built, threads: int) -> dict[str, Any]:
    """Find the equilibrium and its gradient once."""
    x = built.particles.x[:, 0]
    end = x > x.max() - built.model.dx
    model = replace(built.model, probe=csr_array(end[None] / end.sum()))
    values = {f"{LAW}.youngs_modulus": np.array(MODULUS)}

    def found() -> tuple[RestPath, Records]:
        path = RestPath(model, [inputs_of(built, {}, values)], threads=threads)
        return path, path.run(keep=True)

    (path, records), solve = timed(found)
    bar = records.zeros_like()
    bar.x[1, 0, 2] = 1.0
    by_path, gradient = timed(lambda: gradient_of(built, {}, values, path.gradients(bar)[0]))
    (point,) = path.points
    return {
        "solve": solve, "gradient": gradient, "tip_mm": 1e3 * float(records.x[1, 0, 2] - records.x[0, 0, 2]),
        "by_modulus_mm_kPa": 1e6 * float(by_path[f"{LAW}.youngs_modulus"]), "converged": point.rest.converged,
        "residual": point.rest.residual, "steps": point.rest.steps, "products": point.products,
    }  # fmt: skip


def measure(name: str, threads: int, repeat: int) -> dict[str, Any]:
    """Return the fastest of a few repetitions of a case."""
    built = build(load_scene(SCENE, [*AT_REST, *CASES[name]]))
    once(built, threads)
    runs = [once(built, threads) for _ in range(repeat)]
    best = min(runs, key=lambda run: float(run["solve"]["seconds"]))
    best["gradient"] = min((run["gradient"] for run in runs), key=lambda each: float(each["seconds"]))
    return {
        "overrides": CASES[name], "particles": built.particles.layout.n_particles, **best,
        "gradient_share": best["gradient"]["seconds"] / best["solve"]["seconds"],
    }  # fmt: skip


def main() -> None:
    """Measure the cases, and write the file after each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "measured" / "rest.json")
    options = parser.parse_args()
    result = json.loads(options.out.read_text()) if options.out.exists() else {}
    for name in options.only:
        result[name] = measure(name, options.threads, options.repeat)
        source = {"command": "python benchmarks/rest.py", "machine": machine(), "engine": engine_hash()}
        write_json(options.out, {**result, **source, "threads": options.threads})
        solve, gradient = (result[name][key]["seconds"] for key in ("solve", "gradient"))
        print(f"{name}: {solve:.2f} s, gradient {gradient:.2f} s, {result[name]['products']} products", flush=True)


if __name__ == "__main__":
    main()
