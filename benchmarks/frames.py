"""Compare the two frames, and averaged volumes: time of a substep and of a gradient, in one run.

    python benchmarks/frames.py [--dim 3] [--edge 40] [--substeps 200] [--turns 7] [--out FILE]

A block of edge^dim particles with random strain swings freely; the frames take turns. `gradient` is the whole gradient,
with what a frame computes again. Times are in ns a particle and substep; ratios are those of the turns, and their
median is given.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.engine.frames import FRAMES, make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.reference.patches import count_nodes
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import falling_block, machine
from cqrun.state import State
from cqrun.store.atomic import write_json


def loss_bar(records: Records, last: State) -> LossBar:
    """Return the cotangents of the mean of all positions and of a little of the strain."""
    v, C, F = (np.zeros_like(a) for a in (last.v, last.C, last.F))
    return LossBar(final=State(np.full_like(last.x, 1.0 / len(last.x)), v, C, F + 1e-3, last.memory))


def main() -> None:
    """Measure both frames and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--dim", type=int, default=3)
    parser.add_argument("--edge", type=int, default=40)
    parser.add_argument("--substeps", type=int, default=200)
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--budget-mib", type=int, default=2048)
    parser.add_argument("--precision", default="float64")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    model, inputs = falling_block(options.dim, options.edge, np.dtype(options.precision).type)
    n_nodes = count_nodes(model.layout, inputs.state.x, model.dx)
    model = replace(
        model, substeps=options.substeps, n_controls=1, memory_budget=options.budget_mib * 2**20, n_nodes=n_nodes
    )
    rng = np.random.default_rng(0)
    inputs.state.C[:] += rng.normal(size=inputs.state.C.shape)
    inputs.state.F[:] = np.eye(options.dim)
    models = {name: replace(model, frame=name) for name in FRAMES}
    models["averaged"] = replace(models["reference"], averaged=True)
    rollouts = {name: make_rollout(models[name], inputs, threads=options.threads, adjoint=True) for name in models}
    seconds: dict[tuple[str, str], list[float]]
    seconds = {(name, what): [] for name in models for what in ("forward", "gradient")}
    for _ in range(options.turns + 1):
        for name, rollout in rollouts.items():
            for what, run in (("forward", rollout.run), ("gradient", lambda r=rollout: r.gradient(loss_bar))):
                begin = time.perf_counter()
                run()
                seconds[name, what].append(time.perf_counter() - begin)
    per = 1e9 / (len(inputs.state.x) * options.substeps)
    result: dict[str, Any] = {"machine": machine(), "engine": engine_hash()}
    result |= {"particles": len(inputs.state.x), "nodes": n_nodes}
    result |= {key: value for key, value in vars(options).items() if key != "out"}
    for name, what in seconds:
        result[f"{name} {what} [ns]"] = round(float(np.median(seconds[name, what][1:])) * per, 1)
    for what, (one, other) in itertools.product(
        ("forward", "gradient"), (("reference", "updated"), ("averaged", "reference"))
    ):
        pairs = zip(seconds[one, what][1:], seconds[other, what][1:], strict=True)
        result[f"{what}, {one} over {other}"] = round(float(np.median([a / b for a, b in pairs])), 3)
    print("\n".join(f"{name}: {value}" for name, value in result.items()))
    if options.out:
        write_json(options.out, result)


if __name__ == "__main__":
    main()
