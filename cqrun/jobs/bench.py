"""`cqrun bench`: nanoseconds a particle and substep, pass by pass, forward and backward.

A block of fixed-corotated material with its own modulus for every particle falls and deforms, 8 particles a
cell in 3D and 4 in 2D, as in CQ1 Table II. Times are medians over repetitions, all in one process; ratios
within a run mean more than figures across machines.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.engine.backward import Backward
from cqrun.engine.blocks import sort_particles
from cqrun.engine.grid import clear, update_grid, update_grid_vjp
from cqrun.engine.model import GroupModel, Inputs, LossBar, Model
from cqrun.engine.particles import momentum, momentum_vjp, move, move_vjp
from cqrun.engine.probe import make_probe, record, record_vjp
from cqrun.engine.rollout import Rollout
from cqrun.engine.setting import Probe
from cqrun.engine.step import scatter_blocks
from cqrun.fingerprint import engine_hash
from cqrun.lanes import lane_width
from cqrun.materials.fixed_corotated import FixedCorotated
from cqrun.scene.particles import block_order
from cqrun.state import Layout, ParticleFields, State
from cqrun.store.atomic import disk_errors, make_directory, write_json
from cqrun.store.provenance import versions

SIZES = ((2, 80), (3, 20), (3, 40), (3, 80))
"""(dimension, particles along an edge): 6,400 in 2D; 8,000, 64,000 and 512,000 in 3D."""

SUBSTEPS = 8
REPEAT = 9
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


class Bench:
    """One size at one precision and number of threads."""

    def __init__(self, dim: int, edge: int, real: Any, threads: int) -> None:
        self.model, self.inputs = falling_block(dim, edge, real)
        self.n = len(self.inputs.state.x)
        self.rollout = Rollout(self.model, self.inputs, threads=threads, adjoint=True)
        self.states = np.empty((SUBSTEPS + 1, *self.rollout.start.shape), real)
        self.here = np.empty((1, *self.rollout.start.shape), real)
        self.backward = Backward(self.rollout, LossBar(final=State.at_rest(self.inputs.state.x)))

    def forward(self) -> None:
        """Run all substeps, as a rollout without gradient does."""
        self.rollout.advance(0, SUBSTEPS, self.here, keep=False)

    def store(self) -> None:
        """Run all substeps and keep their states."""
        self.rollout.advance(0, SUBSTEPS, self.states, keep=True)

    def rewind(self) -> None:
        """Put the start where both runs begin; no part of a substep, so not timed."""
        self.here[0] = self.states[0] = self.rollout.start

    def reverse(self) -> None:
        """Run the adjoint of all substeps from the kept states."""
        self.backward.run(0, SUBSTEPS, self.states)

    def passes(self) -> Iterator[tuple[str, Callable[[int], Any]]]:
        """Yield every pass by name, in an order in which each finds what it needs."""
        self.rewind()
        self.store()
        r, b, n = self.rollout, self.backward, self.rollout.threads
        group, pair, work, setting = r.groups[0], (r.groups[0], b.groups_bar[0]), r.work, r.setting
        probe, rows = self._probe(), np.ones((r.rows, PARTS))
        q, q_next, fields = self.states[0], self.states[1], r.fields
        yield "momentum", lambda t: momentum(group, q, fields, r.drive.push, setting, work, t, n)
        yield "sort", lambda t: sort_particles(work.blocks, work.place) if t == 0 else None
        yield "clear", lambda t: clear(work.grid, 1, setting, work, t, n)
        yield "scatter", lambda t: scatter_blocks(work.grid, (work.value,), (work.affine,), setting, work, t, n)
        yield "update_grid", lambda t: update_grid(setting, r.conditions, work, t, n)
        yield "move", lambda t: move(group, q, q_next, setting, work, t, n)
        yield "move_vjp", lambda t: move_vjp(group, q, q_next, b.q_bar, setting, work, t, n)
        values, affines = (work.value, work.value_2), (work.affine, work.affine_2)
        yield "clear_both", lambda t: clear(work.both, 2, setting, work, t, n)
        yield "scatter_both", lambda t: scatter_blocks(work.both, values, affines, setting, work, t, n)
        yield "update_grid_vjp", lambda t: update_grid_vjp(setting, r.conditions, work, t, n)
        yield (
            "momentum_vjp",
            lambda t: momentum_vjp(pair, q, b.q_bar, fields, b.fields_bar, b.drive_bar.push, setting, work, t, n),
        )
        yield "record", lambda t: record(probe, q, rows) if t == 0 else None  # once a control step
        yield "record_vjp", lambda t: record_vjp(probe, b.q_bar, rows) if t == 0 else None

    def _probe(self) -> Probe:
        """Return the probe of the centroids of some parts of the block."""
        from scipy import sparse

        part = np.arange(self.n) * PARTS // self.n
        share = 1.0 / np.bincount(part)[part]
        centroids = sparse.csr_array((share, (part, np.arange(self.n))), shape=(PARTS, self.n))
        layout, q = self.model.layout, self.rollout.start
        return make_probe(centroids, layout.columns(), q.shape[1])

    def nanoseconds(self, seconds: list[float], substeps: int) -> float:
        """Return the median, a particle and substep [ns]."""
        return float(np.median(seconds)) / (self.n * substeps) * 1e9

    def measure(self, repeat: int) -> dict[str, Any]:
        """Return ns a particle and substep of the whole and of each pass."""
        whole: dict[str, list[float]] = {"forward": [], "store": [], "backward": []}
        for _ in range(repeat + 1):
            self.rewind()
            for name, run in (("forward", self.forward), ("store", self.store), ("backward", self.reverse)):
                whole[name].append(timed(run))
        result: dict[str, Any] = {k: self.nanoseconds(v[1:], SUBSTEPS) for k, v in whole.items()}
        result["backward_over_forward"] = float(
            np.median(np.array(whole["backward"][1:]) / np.array(whole["forward"][1:]))
        )
        result["passes"] = {}
        for name, body in self.passes():
            seconds = [timed(lambda: self.rollout.team.run(body)) for _ in range(repeat + 1)]  # noqa: B023
            self.backward.q_bar[...] = 0.0
            result["passes"][name] = self.nanoseconds(seconds[1:], 1)
        return result


def timed(run: Callable[[], Any]) -> float:
    """Return how long a call takes [s]."""
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


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
    if output is not None:
        make_directory(output.parent)
        with disk_errors(output), output.open("a"):  # told now, not after all is measured
            pass
    sizes, repeat = (((2, 48), (3, 13)), 2) if quick else (SIZES, REPEAT)
    result: dict[str, Any] = {"machine": machine(), "engine": engine_hash(), "versions": versions(), "rows": []}
    print("ns a particle and substep           forward   store  backward  ratio   passes")
    for dim, edge in sizes:
        for real in (np.float64, np.float32):
            for n_threads in (threads,) if threads else (1, 2):
                bench = Bench(dim, edge, real, n_threads)
                row = {
                    "dimension": dim, "particles": bench.n, "precision": np.dtype(real).name,
                    "threads": bench.rollout.threads, "lane_width": lane_width(real), **bench.measure(repeat),
                }  # fmt: skip
                result["rows"].append(row)
                print(_line(row), flush=True)
    result["two_corners_over_small_world"] = empty_world(8 if quick else CORNERS_LIMIT, repeat)
    print(f"two bodies in opposite corners of 8 times the volume: {result['two_corners_over_small_world']:.3f}")
    if output is not None:
        write_json(output, result)
        print(f"written: {output}")
    return result


def _line(row: dict[str, Any]) -> str:
    head = f"{row['dimension']}D {row['particles']:>7} {row['precision']} {row['threads']} thread(s)"
    whole = f"{row['forward']:8.1f}{row['store']:8.1f}{row['backward']:10.1f}{row['backward_over_forward']:7.2f}"
    return f"{head:<34}{whole}   " + " ".join(f"{name} {ns:.1f}" for name, ns in row["passes"].items())
