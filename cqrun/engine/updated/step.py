"""The passes of a substep and of its adjoint, and the loops over substeps.

Every thread runs these loops; after each pass the threads wait for each other at a barrier (`compile.py`).

If a state does not fit the cache, the last pass of a substep also runs the first pass of the next, tile by tile
(`follows`): the same arithmetic in the same order for each particle, with less traffic to the memory.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.engine.blocks import SORT_EVERY, sort_particles
from cqrun.engine.drive import activate, activate_vjp
from cqrun.engine.probe import record, record_vjp
from cqrun.engine.setting import Crew, Drive, Probe
from cqrun.engine.transfer import scatter
from cqrun.engine.updated.forces import push_if_pulled, push_if_pulled_vjp
from cqrun.engine.updated.grid import add_friction_bar, clear, update_grid, update_grid_vjp
from cqrun.engine.updated.particles import momentum_of_each, momentum_of_each_vjp, move_each, move_each_vjp
from cqrun.engine.updated.setting import Bars, Run, Setting, Substep
from cqrun.forces.force import Levels
from cqrun.numerics.compile import Pass, barrier, in_order, kernel, share
from cqrun.plugin.contract import Array

MAX_TRAVEL = 0.99
"""Cells that a particle may move before particles are sorted again: one, less a margin for rounding (`blocks.py`)."""


@kernel
def scatter_blocks(grid: Array, values: Any, affines: Any, run: Run, crew: Crew) -> None:
    """Scatter all particles, colour by colour, with one or two fields per node (`transfer.scatter`)."""
    setting, work, blocks = run.setting, run.work, run.work.blocks
    for colour in range(8):
        begin, n_work = blocks.colour[colour], blocks.colour[colour + 1] - blocks.colour[colour]
        if n_work > 0:
            lo, hi = share(n_work, crew.thread, crew.n_threads)
            for index in range(begin + lo, begin + hi):
                first, last = blocks.start[index], blocks.start[index + 1]
                scatter(grid, values, affines, work.place, blocks.order, first, last, setting.strides, setting.dims)
            barrier(work.arrivals, crew.n_threads)


@kernel
def sort(run: Run, at: Substep, crew: Crew) -> None:
    """Sort particles if the last sort is no longer valid, on one thread between two barriers."""
    work, setting = run.work, run.setting
    barrier(work.arrivals, crew.n_threads)
    if crew.thread == 0:
        blocks = work.blocks
        fastest = 0.0
        for other in range(crew.n_threads):
            fastest = max(fastest, work.speed[other])
            work.speed[other] = 0.0
        blocks.travel[0] += np.sqrt(fastest) * setting.dt / setting.dx
        if at.due % SORT_EVERY == 0 or not blocks.travel[0] < MAX_TRAVEL:
            sort_particles(blocks, work.place)
    barrier(work.arrivals, crew.n_threads)


WORK = "run.work"
MEET = Pass("meet", barrier, f"{WORK}.arrivals, crew.n_threads")

FORWARD = (
    Pass("momentum", momentum_of_each, "groups, run, at, crew", tiled=True),
    Pass("forces", push_if_pulled, "drive.pulled, groups, drive, run, at, crew"),
    Pass("sort", sort, "run, at, crew"),
    Pass("clear", clear, f"{WORK}.grid, 1, run, crew"),
    MEET,
    Pass("scatter", scatter_blocks, f"{WORK}.grid, ({WORK}.value,), ({WORK}.affine,), run, crew"),
    Pass("update_grid", update_grid, "conditions, run, crew"),
    MEET,
    Pass("move", move_each, "groups, run, at, crew", tiled=True),
)
"""The passes of a substep: q_next = one substep from q."""

BACKWARD = (
    Pass("move_vjp", move_each_vjp, "pairs, run, bars, at, crew", tiled=True),
    *FORWARD[:3],  # the fields that P2G scatters, once more
    Pass("clear_both", clear, f"{WORK}.both, 2, run, crew"),
    MEET,
    Pass(
        "scatter_both", scatter_blocks,
        f"{WORK}.both, ({WORK}.value, {WORK}.value_2), ({WORK}.affine, {WORK}.affine_2), run, crew",
    ),
    Pass("update_grid_vjp", update_grid_vjp, "conditions, run, crew"),
    MEET,
    Pass("friction_vjp", add_friction_bar, "coefficient_bar, run, crew"),
    Pass("momentum_vjp", momentum_of_each_vjp, "pairs, run, bars, at, crew", tiled=True),
    Pass("forces_vjp", push_if_pulled_vjp, "drive.pulled, pairs, drive, levels_bar, run, bars, at, crew"),
)  # fmt: skip
"""The passes of a substep's adjoint: they turn bars.q from the cotangent of q_next into that of q."""

substep = in_order("substep", "groups, conditions, drive, run, at, crew", FORWARD)
substep_vjp = in_order(
    "substep_vjp", "groups, pairs, conditions, coefficient_bar, drive, levels_bar, run, bars, at, crew", BACKWARD
)


@kernel
def follows(step: int, setting: Setting) -> bool:
    """Return whether a substep follows the previous one tile by tile, which it can within a control step."""
    return setting.chained and step % setting.substeps != 0


@kernel
def advance(
    groups: Any, conditions: Any, drive: Drive, run: Run, states: Array, begin: int, end: int, keep: bool, probe: Probe,
    records: Array, crew: Crew,
) -> int:  # fmt: skip
    """Run substeps begin .. end from states[0]; return the substep reached.

    With `keep`, states[k] becomes the state after k substeps; otherwise states[0] is overwritten. Stop early if a
    particle is stray (`work.stray`). Record the state at the end of every control step.
    """
    setting, work = run.setting, run.work
    for step in range(begin, end):
        here = step - begin if keep else 0
        q, q_next = states[here], states[here + 1] if keep else states[here]
        control = step // setting.substeps
        if step % setting.substeps == 0 or step == begin:
            if crew.thread == 0:
                activate(drive, run.fields, run.push, control)
            barrier(work.arrivals, crew.n_threads)
        begun, ahead = step > begin and follows(step, setting), step + 1 < end and follows(step + 1, setting)
        q_after = states[here + 2] if keep and ahead else q_next
        substep(groups, conditions, drive, run, Substep(control, step, begun, ahead, q, q_next, q, q_after), crew)
        barrier(work.arrivals, crew.n_threads)
        for other in range(crew.n_threads):
            if work.stray[other] >= 0:
                return step + 1
        if (step + 1) % setting.substeps == 0 and crew.thread == 0:
            record(probe, q_next, records[control + 1])
    return end


@kernel
def reverse(
    groups: Any, pairs: Any, conditions: Any, coefficient_bar: Array, drive: Drive, stresses: Any, levels_bar: Levels,
    run: Run, bars: Bars, states: Array, begin: int, end: int, probe: Probe, records_bar: Array, crew: Crew,
) -> None:  # fmt: skip
    """Run the adjoints of substeps end - 1 .. begin; states[k] is the state of substep begin + k.

    `pairs` and `stresses` are the groups and the active stresses, each with its cotangent.
    """
    setting, work = run.setting, run.work
    for step in range(end - 1, begin - 1, -1):
        q, q_next = states[step - begin], states[step - begin + 1]
        control = step // setting.substeps
        if (step + 1) % setting.substeps == 0 or step == end - 1:
            if crew.thread == 0:
                activate(drive, run.fields, run.push, control)
                if (step + 1) % setting.substeps == 0:
                    record_vjp(probe, bars.q, records_bar[control + 1])
            barrier(work.arrivals, crew.n_threads)
        # sort at the end of the chunk and at every SORT_EVERY substeps
        due = 0 if step == end - 1 or (step + 1) % SORT_EVERY == 0 else 1
        begun, ahead = step + 1 < end and follows(step + 1, setting), step > begin and follows(step, setting)
        q_before = states[step - begin - 1] if ahead else q
        at = Substep(control, due, begun, ahead, q, q_next, q_before, q_next)
        substep_vjp(groups, pairs, conditions, coefficient_bar, drive, levels_bar, run, bars, at, crew)
        barrier(work.arrivals, crew.n_threads)
        if step % setting.substeps == 0 and crew.thread == 0:
            activate_vjp(stresses, drive, levels_bar, run.fields, bars.fields, bars.steady_push, control)
        barrier(work.arrivals, crew.n_threads)
