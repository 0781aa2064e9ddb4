"""`cqrun bench SCENE`: where the time of a scene's own rollouts goes, pass by pass, and what a gradient costs.

The scene is run to the middle, under its controller as it starts; from there some substeps are run again and again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.engine.blocks import SORT_EVERY
from cqrun.engine.rollout import Rollout
from cqrun.errors import RolloutError, RunError
from cqrun.fingerprint import engine_hash
from cqrun.jobs.bench import REPEAT, machine, memory_speed, require_writable
from cqrun.jobs.excerpt import Excerpt
from cqrun.jobs.simulate import make_agent
from cqrun.numerics.lanes import lane_width
from cqrun.running.gradient_memory import gradient_plan
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter
from cqrun.running.runs import build_and_warn
from cqrun.running.threads import cores
from cqrun.scene.load import load_scene
from cqrun.store.atomic import write_json
from cqrun.store.provenance import versions

SUBSTEPS = 10
"""Of an excerpt, at least: whole control steps."""


@dataclass(frozen=True)
class Share:
    """A pass: ns a particle and substep, and its share of the whole, forward or backward."""

    name: str
    nanoseconds: float
    share: float


def run_bench_scene(
    source: Path, overrides: Sequence[str], output: Path | None, *, threads: int | None, talk: Reporter
) -> list[str]:
    """Measure a scene; return the lines of a table, and write JSON if asked for.

    Raises:
        SceneError: bad input, or a gradient that does not fit the memory. RunError: it blew up.
    """
    require_writable(output)
    built = build_and_warn(load_scene(source, overrides), talk)
    plan = gradient_plan(built)
    compile_kernels([built], talk, adjoint=True)
    try:
        excerpt = excerpt_of(built, cores(threads), talk)
        talk.phase("measuring")
        found = excerpt.measure(REPEAT)
    except RolloutError as error:
        raise RunError(f"{source}: {error}") from error
    model, rollout = built.model, excerpt.rollout
    particle_steps = 1e-9 * model.layout.n_particles * model.n_steps
    seconds = {
        "forward": found["forward"] * particle_steps,
        "gradient": (found["store"] * plan.recompute + found["backward"]) * particle_steps,
    }
    told = {
        "scene": source.name, "overrides": list(overrides), "machine": machine(), "engine": engine_hash(),
        "versions": versions(), "dimension": model.dim, "particles": model.layout.n_particles,
        "substeps": model.n_steps, "precision": np.dtype(model.real).name, "threads": rollout.threads,
        "lane_width": lane_width(model.real), "recompute": plan.recompute, "seconds": seconds,
        "memory_GB_per_s": memory_speed(rollout.threads), **found,
    }  # fmt: skip
    if output is not None:
        write_json(output, told)
    return [*table(told), *([f"written: {output}"] if output is not None else [])]


def excerpt_of(built: Built, threads: int, talk: Reporter) -> Excerpt:
    """Return some substeps from the middle of a scene's rollout, run so far."""
    agent, model = make_agent(built, None, talk), built.model
    if agent is None:
        rollout = Rollout(model, built.assembly.inputs({}), threads=threads, adjoint=True)
    else:
        rollout = agent.rollout(agent.acting, agent.goals_in_the_middle, threads, adjoint=True)
    steps = min(-(-SUBSTEPS // model.substeps), model.n_controls)
    even = SORT_EVERY // gcd(SORT_EVERY, model.substeps)  # from where a repeated run repeats its bits
    middle = (model.n_controls - steps) // 2 // even * even
    states = rollout.start[None].copy()
    talk.phase(f"running {model.layout.n_particles:,} particles to the middle")
    for control in range(middle):
        if talk.stop.asked:
            raise talk.stop.stopped("stopped before anything was measured")
        rollout.advance(control * model.substeps, (control + 1) * model.substeps, states, keep=False)
        talk.advance(control + 1, middle, f"t = {(control + 1) * built.scene.time.control_step:.4g} s")
    return Excerpt(rollout, middle * model.substeps, steps * model.substeps, states[0])


def shares(told: dict[str, Any], whole: str) -> Iterator[Share]:
    """Yield the passes of a forward or a backward run, and what their sum leaves."""
    passes = told["passes"]
    own = {name: ns for name, ns in passes.items() if name.endswith(("_vjp", "_both")) == (whole == "backward")}
    if whole == "backward":  # the substep's first part is run again, for what it scatters
        own = {name: passes[name] for name in ("momentum", "forces", "sort") if name in passes} | own
    own["the rest"] = told[whole] - sum(own.values())
    for name, ns in own.items():
        yield Share(name, ns, ns / told[whole])


def table(told: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of what was found."""
    threads = f"{told['threads']} thread{'s' if told['threads'] > 1 else ''}"
    yield f"{told['particles']:,} particles, {told['substeps']:,} substeps, {told['precision']}, {threads}"
    yield f"{'ns a particle and substep':<28}{'':>8}  of it"
    for whole in ("forward", "backward"):
        yield f"{whole:<28}{told[whole]:8.1f}"
        for share in shares(told, whole):
            yield f"  {share.name:<26}{share.nanoseconds:8.1f}  {share.share:5.0%}"
    seconds = told["seconds"]
    again = "" if told["recompute"] == 1 else f", where {told['recompute']:.2f} substeps forward are run for each"
    yield f"memory copied by {threads}: {told['memory_GB_per_s']:.3g} GB/s, read and written"
    yield f"one rollout {_time(seconds['forward'])}; with its gradient {_time(seconds['gradient'])}{again}"


def _time(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 99.5 else f"{seconds / 60:.3g} min"
