"""`cqrun bench`: nanoseconds a particle and substep, pass by pass, forward and backward.

A block of fixed-corotated material with its own modulus for every particle falls and deforms, 8 particles a
cell in 3D and 4 in 2D, as in CQ1 Table II. Times are medians over repetitions, all in one process; ratios
within a run mean more than figures across machines.
"""

from __future__ import annotations

import os
import platform
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from cqrun.build.particles import block_order
from cqrun.engine.model import GroupModel, Inputs, Model
from cqrun.engine.rollout import Rollout
from cqrun.fingerprint import engine_hash
from cqrun.jobs.excerpt import Excerpt, timed
from cqrun.materials.fixed_corotated import FixedCorotated
from cqrun.numerics.lanes import lane_width
from cqrun.state import Layout, ParticleFields, State
from cqrun.store.atomic import disk_errors, make_directory, write_json
from cqrun.store.provenance import versions

SIZES = ((2, 80), (3, 20), (3, 40), (3, 80), (2, 320))
"""(dimension, particles along an edge): 6,400 in 2D; 8,000, 64,000 and 512,000 in 3D; 102,400 in 2D."""

SUBSTEPS = 8
REPEAT = 9
COPIED = 128 << 20
"""Bytes that a core copies at a time to measure the memory's speed: more than the last cache holds."""

PARTS = 8
"""Of the block, whose centroids are recorded."""

CORNERS_LIMIT = 20
"""Particles along an edge of each of the two blocks that measure the cost of empty world."""


def falling_block(dim: int, edge: int, real: Any, *, world: float = 2.0, corners: bool = False) -> tuple[Model, Inputs]:
    """Return a block of edge^dim particles in the unit box's middle, or two in opposite corners of the world.

    Args:
        world: edge of the world over that of the block.
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
    """Return the first substeps of a falling block, the centroids of whose parts are recorded."""
    model, inputs = falling_block(dim, edge, real)
    n = model.layout.n_particles
    part = np.arange(n) * PARTS // n
    share = 1.0 / np.bincount(part)[part]
    centroids = sparse.csr_array((share, (part, np.arange(n))), shape=(PARTS, n))
    rollout = Rollout(replace(model, probe=centroids), inputs, threads=threads, adjoint=True)
    return Excerpt(rollout, 0, SUBSTEPS)


def empty_world(edge: int, repeat: int) -> float:
    """Return the cost of two blocks in opposite corners of 8 times the volume, over that of the small world.

    The median of the ratios of alternating runs, one thread, float64.
    """
    rollouts = []
    for world in (2.5, 5.0):
        model, inputs = falling_block(3, edge, np.float64, world=world, corners=True)
        rollouts.append(Rollout(model, inputs))

    def run(rollout: Rollout) -> float:
        here = rollout.start[None].copy()
        return timed(lambda: rollout.advance(0, SUBSTEPS, here, keep=False))

    ratios = []
    for _ in range(repeat + 1):
        small, large = (run(rollout) for rollout in rollouts)
        ratios.append(large / small)
    return float(np.median(ratios[1:]))


def memory_speed(threads: int) -> float:
    """Return how much so many cores read and write together as they copy what no cache holds [GB/s].

    The median of repetitions. A pass that streams through the memory does hardly more.
    """
    arrays = [(np.ones(COPIED, np.uint8), np.ones(COPIED, np.uint8)) for _ in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        seconds = [timed(lambda: list(pool.map(lambda pair: np.copyto(*pair), arrays))) for _ in range(REPEAT)]
    return 2.0 * COPIED * threads / float(np.median(seconds)) * 1e-9


def machine() -> dict[str, Any]:
    """Return what the figures depend on."""
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    load = os.getloadavg() if hasattr(os, "getloadavg") else ()
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "load": [round(a, 2) for a in load],
        "system": platform.system(),
    }


def run_bench(output: Path | None, *, threads: int | None = None, quick: bool = False) -> dict[str, Any]:
    """Measure, print a table, and write JSON if asked for; return what is written."""
    require_writable(output)
    sizes, repeat = (((2, 48), (3, 13)), 2) if quick else (SIZES, REPEAT)
    result: dict[str, Any] = {"machine": machine(), "engine": engine_hash(), "versions": versions(), "rows": []}
    print("ns a particle and substep           forward   store  backward  ratio   passes")
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
    """Say now that a file cannot be written, not after all is measured."""
    if output is not None:
        make_directory(output.parent)
        with disk_errors(output), output.open("a"):
            pass


def _line(row: dict[str, Any]) -> str:
    head = f"{row['dimension']}D {row['particles']:>7} {row['precision']} {row['threads']} thread(s)"
    whole = f"{row['forward']:8.1f}{row['store']:8.1f}{row['backward']:10.1f}{row['backward_over_forward']:7.2f}"
    return f"{head:<34}{whole}   " + " ".join(f"{name} {ns:.1f}" for name, ns in row["passes"].items())
