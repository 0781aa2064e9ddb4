"""`cqrun bench`: measure nanoseconds per particle and substep, for each pass, forward and backward.

Without a scene it measures a falling block of fixed-corotated material, with its own modulus for every particle and 8
particles per cell in 3D, 4 in 2D, as in CQ1 Table II. For a scene it measures substeps from the middle of the rollout,
with the untrained controller, and the cost of a gradient. Times are medians over repetitions in one process. Ratios in
one run are more reliable than comparisons of machines.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import gcd
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from cqrun.build.model import Built
from cqrun.build.particles import block_order
from cqrun.engine.blocks import SORT_EVERY
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import GroupModel, Inputs, Model
from cqrun.engine.rollout import Rollout
from cqrun.errors import RolloutError, RunError
from cqrun.fingerprint import engine_hash
from cqrun.learning.acting import make_agent
from cqrun.materials.fixed_corotated import FixedCorotated
from cqrun.numerics.lanes import lane_width
from cqrun.running.excerpt import Excerpt, timed
from cqrun.running.gradient_memory import gradient_plan
from cqrun.running.kernels import compile_kernels
from cqrun.running.reporter import Reporter
from cqrun.running.runs import build_and_warn
from cqrun.running.threads import cores
from cqrun.scene.load import load_scene
from cqrun.state import Layout, ParticleFields, State
from cqrun.store.atomic import disk_errors, make_directory, write_json
from cqrun.store.provenance import machine as run_on
from cqrun.store.provenance import versions

SIZES = ((2, 80), (3, 20), (3, 40), (3, 80), (2, 320))
"""(dimension, particles along an edge): 6,400 in 2D; 8,000, 64,000 and 512,000 in 3D; 102,400 in 2D."""

SUBSTEPS = 8
REPEAT = 9
COPIED = 128 << 20
"""Bytes that a core copies to measure the speed of the memory: more than the last cache holds."""

PARTS = 8
"""Number of parts of the block whose centroids are recorded."""

CORNERS_LIMIT = 20
"""Particles along an edge of each of the two blocks that measure the cost of empty space."""

SCENE_SUBSTEPS = 10
"""Smallest number of substeps that are measured in a scene; they are whole control steps."""


def falling_block(dim: int, edge: int, real: Any, *, world: float = 2.0, corners: bool = False) -> tuple[Model, Inputs]:
    """Return a block of edge^dim particles in the middle of the world, or two in opposite corners.

    Args:
        world: edge of the world divided by that of the block.
    """
    spacing = 1.0 / edge
    dx = 2.0 * spacing
    axis = (np.arange(edge) + 0.5) * spacing
    block = np.stack(np.meshgrid(*[axis] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
    places = [0.05 * world, 0.95 * world - 1.0] if corners else [0.5 * (world - 1.0)]
    x = np.concatenate([block + place for place in places])
    x = x[block_order(x, dx)]
    n = len(x)
    rng = np.random.default_rng(0)
    state = State.at_rest(x)
    state.v[:] = 0.1 * np.sin(5.0 * x)
    state.F += 0.02 * rng.standard_normal(state.F.shape)
    fields = ParticleFields.zeros(n, dim)
    fields.volume[:] = spacing**dim
    fields.mass[:] = fields.volume
    fields.force[:, -1] = -fields.mass
    theta = np.array([rng.uniform(9.0, 11.0, n), np.full(n, 0.3)])
    material = FixedCorotated(youngs_modulus=10.0, poissons_ratio=0.3)
    group = GroupModel((0,), (material.kernel_term,))
    dt = 0.05 * dx
    model = Model(np.full(dim, world), dx, dt, SUBSTEPS, 1, ("block",), Layout(dim, (n,)), (group,), real=real)
    return model, Inputs(state, fields, [[theta]], np.zeros((1, 0)), np.zeros(0))


def excerpt_of_block(dim: int, edge: int, real: Any, threads: int) -> Excerpt:
    """Return the first substeps of a falling block; the centroids of its parts are recorded."""
    model, inputs = falling_block(dim, edge, real)
    n = model.layout.n_particles
    part = np.arange(n) * PARTS // n
    share = 1.0 / np.bincount(part)[part]
    centroids = sparse.csr_array((share, (part, np.arange(n))), shape=(PARTS, n))
    rollout = make_rollout(replace(model, probe=centroids), inputs, threads=threads, adjoint=True)
    return Excerpt(rollout, 0, SUBSTEPS)


def empty_world(edge: int, repeat: int) -> float:
    """Return the time of two blocks in opposite corners of 8 times the volume divided by that in the small world.

    It is the median of the ratios of alternating runs on one thread in float64.
    """
    rollouts = []
    for world in (2.5, 5.0):
        model, inputs = falling_block(3, edge, np.float64, world=world, corners=True)
        rollouts.append(make_rollout(model, inputs))

    def run(rollout: Rollout) -> float:
        here = rollout.start[None].copy()
        return timed(lambda: rollout.advance(0, SUBSTEPS, here, keep=False))

    ratios = []
    for _ in range(repeat + 1):
        small, large = (run(rollout) for rollout in rollouts)
        ratios.append(large / small)
    return float(np.median(ratios[1:]))


def memory_speed(threads: int) -> float:
    """Return how much data this number of cores reads and writes when it copies arrays larger than the cache [GB/s].

    It is the median of repetitions, and about the limit for a pass that streams through the memory.
    """
    arrays = [(np.ones(COPIED, np.uint8), np.ones(COPIED, np.uint8)) for _ in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        seconds = [timed(lambda: list(pool.map(lambda pair: np.copyto(*pair), arrays))) for _ in range(REPEAT)]
    return 2.0 * COPIED * threads / float(np.median(seconds)) * 1e-9


def machine() -> dict[str, Any]:
    """Return facts about the machine that the times depend on."""
    load = os.getloadavg() if hasattr(os, "getloadavg") else ()
    return run_on() | {"load": [round(a, 2) for a in load], "system": platform.system()}


def run_bench(output: Path | None, *, threads: int | None = None, quick: bool = False) -> dict[str, Any]:
    """Measure, print a table, write it as JSON if `output` is given, and return it."""
    require_writable(output)
    sizes, repeat = (((2, 48), (3, 13)), 2) if quick else (SIZES, REPEAT)
    result: dict[str, Any] = {"machine": machine(), "engine": engine_hash(), "versions": versions(), "rows": []}
    print("ns per particle and substep         forward   store  backward  ratio   passes")
    for dim, edge in sizes:
        for real in (np.float64, np.float32):
            for n_threads in (threads,) if threads else (1, 2):
                bench = excerpt_of_block(dim, edge, real, n_threads)
                row = {
                    "dimension": dim, "particles": bench.n, "precision": np.dtype(real).name,
                    "threads": bench.rollout.threads, "lane_width": lane_width(real), **bench.measure(repeat),
                }  # fmt: skip
                result["rows"].append(row)
                print(_line(row), flush=True)
    result["memory_GB_per_s"] = {str(n): memory_speed(n) for n in ((threads,) if threads else (1, 2))}
    for n, speed in result["memory_GB_per_s"].items():
        print(f"memory copied by {n} thread{'s' if n != '1' else ''}: {speed:.3g} GB/s, read and written")
    result["two_corners_over_small_world"] = empty_world(8 if quick else CORNERS_LIMIT, repeat)
    print(f"two bodies in opposite corners of 8 times the volume: {result['two_corners_over_small_world']:.3f}")
    if output is not None:
        write_json(output, result)
        print(f"written: {output}")
    return result


def require_writable(output: Path | None) -> None:
    """Raise an error before the measurements if a file cannot be written."""
    if output is not None:
        make_directory(output.parent)
        with disk_errors(output), output.open("a"):
            pass


def _line(row: dict[str, Any]) -> str:
    head = f"{row['dimension']}D {row['particles']:>7} {row['precision']} {row['threads']} thread(s)"
    whole = f"{row['forward']:8.1f}{row['store']:8.1f}{row['backward']:10.1f}{row['backward_over_forward']:7.2f}"
    return f"{head:<34}{whole}   " + " ".join(f"{name} {ns:.1f}" for name, ns in row["passes"].items())


# --- a scene's own substeps -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Share:
    """A pass: ns per particle and substep, and its share of the whole, forward or backward."""

    name: str
    nanoseconds: float
    share: float


def run_bench_scene(
    source: Path, overrides: Sequence[str], output: Path | None, *, threads: int | None, talk: Reporter
) -> list[str]:
    """Measure a scene; return the lines of a table, and write it as JSON if `output` is given.

    Raises:
        SceneError: bad input, or a gradient does not fit the memory. RunError: the scene blew up.
    """
    require_writable(output)
    built = build_and_warn(load_scene(source, overrides), talk)
    plan = gradient_plan(built)
    compile_kernels([built], talk, adjoint=True)
    try:
        excerpt = excerpt_of(built, cores(threads), talk)
        talk.phase("measuring")
        times = excerpt.measure(REPEAT)
    except RolloutError as error:
        raise RunError(f"{source}: {error}") from error
    model, rollout = built.model, excerpt.rollout
    particle_steps = 1e-9 * model.layout.n_particles * model.n_steps
    seconds = {
        "forward": times["forward"] * particle_steps,
        "gradient": (times["store"] * plan.recompute + times["backward"]) * particle_steps,
    }
    result = {
        "scene": source.name, "overrides": list(overrides), "machine": machine(), "engine": engine_hash(),
        "versions": versions(), "dimension": model.dim, "particles": model.layout.n_particles,
        "substeps": model.n_steps, "precision": np.dtype(model.real).name, "threads": rollout.threads,
        "lane_width": lane_width(model.real), "recompute": plan.recompute, "seconds": seconds,
        "memory_GB_per_s": memory_speed(rollout.threads), **times,
    }  # fmt: skip
    if output is not None:
        write_json(output, result)
    return [*scene_lines(result), *([f"written: {output}"] if output is not None else [])]


def excerpt_of(built: Built, threads: int, talk: Reporter) -> Excerpt:
    """Run a scene to the middle and return the next substeps."""
    agent, model = make_agent(built, None, talk), built.model
    if agent is None:
        rollout = make_rollout(model, built.assembly.inputs({}), threads=threads, adjoint=True)
    else:
        rollout = agent.rollout(agent.acting, agent.goals_in_the_middle, threads, adjoint=True)
    steps = min(-(-SCENE_SUBSTEPS // model.substeps), model.n_controls)
    even = SORT_EVERY // gcd(SORT_EVERY, model.substeps)  # so that a repeated run is bit-for-bit identical
    middle = (model.n_controls - steps) // 2 // even * even
    states = rollout.start[None].copy()
    talk.phase(f"running {model.layout.n_particles:,} particles to the middle")
    for control in range(middle):
        if talk.stop.asked:
            raise talk.stop.stopped("stopped before anything was measured")
        rollout.advance(control * model.substeps, (control + 1) * model.substeps, states, keep=False)
        talk.advance(control + 1, middle, f"t = {(control + 1) * built.scene.time.control_step:.4g} s")
    return Excerpt(rollout, middle * model.substeps, steps * model.substeps, states[0])


def shares(result: dict[str, Any], whole: str) -> Iterator[Share]:
    """Yield the passes of a forward or a backward run, and the rest of the total time."""
    passes = result["passes"]
    times = {name: ns for name, ns in passes.items() if name.endswith(("_vjp", "_both")) == (whole == "backward")}
    if whole == "backward":  # the first passes of the substep run again for the fields that P2G scatters
        times = {name: passes[name] for name in ("momentum", "forces", "sort") if name in passes} | times
    times["the rest"] = result[whole] - sum(times.values())
    for name, ns in times.items():
        yield Share(name, ns, ns / result[whole])


def scene_lines(result: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the table of a scene."""
    threads = f"{result['threads']} thread{'s' if result['threads'] > 1 else ''}"
    yield f"{result['particles']:,} particles, {result['substeps']:,} substeps, {result['precision']}, {threads}"
    yield f"{'ns per particle and substep':<28}{'':>8}  share"
    for whole in ("forward", "backward"):
        yield f"{whole:<28}{result[whole]:8.1f}"
        for share in shares(result, whole):
            yield f"  {share.name:<26}{share.nanoseconds:8.1f}  {share.share:5.0%}"
    seconds, factor = result["seconds"], result["recompute"]
    again = "" if factor == 1 else f", which runs {factor:.2f} forward substeps for each substep"
    yield f"memory copied by {threads}: {result['memory_GB_per_s']:.3g} GB/s, read and written"
    yield f"one rollout {_duration(seconds['forward'])}; with its gradient {_duration(seconds['gradient'])}{again}"


def _duration(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 99.5 else f"{seconds / 60:.3g} min"
