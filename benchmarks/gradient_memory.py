"""Measure the memory of one gradient: 10,000 substeps of 64,000 particles in 3D, with a budget of 2 GiB for states.

    python benchmarks/gradient_memory.py [--frame reference] [--substeps 10000] [--budget-mib 2048] [--out FILE]

A block at rest with random strain swings freely; in the reference frame it is at rest, and its particles have random
rates instead. The loss is the mean of all final positions. The file says how many states were kept, how often a substep
was repeated, the peak memory of the process, the most that the arrays of the rollout and its gradient take, and the
time. The exact gradient by each of the N velocities is the time over N, because momentum is conserved.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np

from cqrun.engine.frames import FRAMES, make_rollout
from cqrun.engine.model import LossBar, Records
from cqrun.engine.reference.patches import count_nodes
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import falling_block, machine
from cqrun.state import State
from cqrun.store.atomic import write_json


def main() -> None:
    """Compute one gradient and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frame", choices=FRAMES, default="updated")
    parser.add_argument("--substeps", type=int, default=10_000)
    parser.add_argument("--edge", type=int, default=40)
    parser.add_argument("--budget-mib", type=int, default=2048)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("benchmarks/measured/gradient_memory.json"))
    options = parser.parse_args()
    model, inputs = falling_block(3, options.edge, np.float64)
    model = replace(model, substeps=options.substeps, n_controls=1, memory_budget=options.budget_mib * 2**20)
    inputs.state.v[:] = 0.0
    inputs.fields.force[:] = 0.0
    if options.frame == "reference":
        inputs.state.F[:] = np.eye(3)
        inputs.state.C[:] = np.random.default_rng(0).normal(size=inputs.state.C.shape)
        model = replace(model, frame="reference", n_nodes=count_nodes(model.layout, inputs.state.x, model.dx))
    n = len(inputs.state.x)

    def loss_bar(records: Records, last: State) -> LossBar:
        v, C, F = (np.zeros_like(a) for a in (last.v, last.C, last.F))
        return LossBar(final=State(np.full_like(last.x, 1.0 / n), v, C, F, last.memory))

    make_rollout(replace(model, substeps=2), inputs, threads=options.threads, adjoint=True).gradient(
        loss_bar
    )  # compile
    tracemalloc.start()
    rollout = make_rollout(model, inputs, threads=options.threads, adjoint=True)
    begin = time.perf_counter()
    _, bar = rollout.gradient(loss_bar)
    seconds = time.perf_counter() - begin
    plan = rollout.plan
    assert plan is not None
    truth = model.dt * model.n_steps / n
    result = {
        "command": f"python benchmarks/gradient_memory.py --frame {options.frame}",
        "machine": machine(),
        "engine": engine_hash(),
        "particles": n,
        "substeps": options.substeps,
        "threads": rollout.threads,
        "budget_bytes": model.memory_budget,
        "states_kept": plan.states,
        "states_kept_bytes": plan.states * rollout.state_bytes,
        "peak_array_bytes": tracemalloc.get_traced_memory()[1],
        "peak_resident_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "forward_substeps_for_each": plan.recompute,
        "seconds": seconds,
        "ns_a_particle_and_substep": seconds / (n * options.substeps) * 1e9,
        "greatest_error": float(np.abs(bar.state.v / truth - 1.0).max()),
    }
    write_json(options.out, result)
    print("\n".join(f"{name}: {value}" for name, value in result.items()))


if __name__ == "__main__":
    main()
