"""The substep as a list of passes, and its adjoint, that list reversed; the loops over substeps.

Every thread runs these loops with its own number and meets the others after each pass (`compile.py`).

Where a state does not fit the cache, the last pass of a substep does the first of the next as well, tile by tile
(`follows`): the same arithmetic in the same order for each particle, with fewer ways to the memory. A substep whose
first pass is done already was `begun`; one that does the next one's goes `ahead`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.engine.blocks import SORT_EVERY, sort_particles
from cqrun.engine.drive import activate, activate_vjp, push_particles, push_particles_vjp
from cqrun.engine.grid import add_friction_bar, clear, update_grid, update_grid_vjp
from cqrun.engine.particles import momentum, momentum_vjp, move, move_vjp
from cqrun.engine.probe import record, record_vjp
from cqrun.engine.setting import Drive, Probe, Setting, Work
from cqrun.engine.transfer import scatter
from cqrun.numerics.compile import barrier, for_each, kernel, share
from cqrun.plugin.contract import Array

MAX_TRAVEL = 0.99
"""Cells that a particle may move before particles are sorted again (`blocks.py`: one, less round-off)."""


@kernel
def scatter_blocks(
    grid: Array, values: Any, affines: Any, setting: Setting, work: Work, thread: int, n_threads: int
) -> None:
    """Scatter all particles, colour by colour; one field to a node or two (`transfer.scatter`)."""
    blocks = work.blocks
    for colour in range(8):
        begin, n_work = blocks.colour[colour], blocks.colour[colour + 1] - blocks.colour[colour]
        if n_work > 0:
            lo, hi = share(n_work, thread, n_threads)
            for index in range(begin + lo, begin + hi):
                first, last = blocks.start[index], blocks.start[index + 1]
                scatter(grid, values, affines, work.place, blocks.order, first, last, setting.strides, setting.dims)
            barrier(work.arrivals, n_threads)


momentum_of_each = for_each(momentum)
move_each = for_each(move)
move_each_vjp = for_each(move_vjp)
momentum_of_each_vjp = for_each(momentum_vjp)


@kernel
def sort_if_due(step: int, setting: Setting, work: Work, thread: int, n_threads: int) -> None:
    """Sort particles where the last sort no longer serves; one thread, between two barriers."""
    barrier(work.arrivals, n_threads)
    if thread == 0:
        blocks = work.blocks
        fastest = 0.0
        for other in range(n_threads):
            fastest = max(fastest, work.speed[other])
            work.speed[other] = 0.0
        blocks.travel[0] += np.sqrt(fastest) * setting.dt / setting.dx
        if step % SORT_EVERY == 0 or not blocks.travel[0] < MAX_TRAVEL:
            sort_particles(blocks, work.place)
    barrier(work.arrivals, n_threads)


@kernel
def follows(step: int, setting: Setting) -> bool:
    """Say whether a substep follows the one before it tile by tile: it does within a control step."""
    return setting.chained and step % setting.substeps != 0


@kernel
def fields_of_particles(
    step: int, control: int, begun: bool, groups: Any, q: Array, fields: Array, drive: Drive, setting: Setting,
    work: Work, thread: int, n_threads: int,
) -> None:  # fmt: skip
    """The first part of a substep: what P2G scatters from the state q, and in which order."""
    if drive.push.shape[0] > 0:
        if thread == 0:
            push_particles(drive, control, q, fields)
        barrier(work.arrivals, n_threads)
    if not begun:
        momentum_of_each(groups, q, fields, drive.push, setting, work, thread, n_threads)
    sort_if_due(step, setting, work, thread, n_threads)


@kernel
def substep(
    step: int, begun: bool, ahead: bool, groups: Any, conditions: Any, q: Array, q_next: Array, fields: Array,
    drive: Drive, setting: Setting, work: Work, thread: int, n_threads: int,
) -> None:  # fmt: skip
    """q_next = one substep from q."""
    control = step // setting.substeps
    fields_of_particles(step, control, begun, groups, q, fields, drive, setting, work, thread, n_threads)
    clear(work.grid, 1, setting, work, thread, n_threads)
    barrier(work.arrivals, n_threads)
    scatter_blocks(work.grid, (work.value,), (work.affine,), setting, work, thread, n_threads)
    update_grid(setting, conditions, work, thread, n_threads)
    barrier(work.arrivals, n_threads)
    move_each(groups, q, q_next, fields, drive.push, ahead, setting, work, thread, n_threads)


@kernel
def substep_vjp(
    due: int, begun: bool, ahead: bool, control: int, groups: Any, pairs: Any, conditions: Any, coefficient_bar: Array,
    q_before: Array, q: Array, q_next: Array, q_bar: Array, fields: Array, fields_bar: Array, drive: Drive,
    drive_bar: Drive, setting: Setting, work: Work, thread: int, n_threads: int,
) -> None:  # fmt: skip
    """Turn q_bar from the cotangent of q_next into that of q; add to those of the parameters.

    Args:
        due: stands for the substep's number: particles are sorted where it is a multiple of SORT_EVERY.
        pairs: every group with its cotangent.
        q_before: the state that the substep before this began from; used if that follows at once (`ahead`).
    """
    if not begun:
        move_each_vjp(groups, q, q_next, q_bar, setting, work, thread, n_threads)
    fields_of_particles(due, control, begun, groups, q, fields, drive, setting, work, thread, n_threads)
    clear(work.both, 2, setting, work, thread, n_threads)
    barrier(work.arrivals, n_threads)
    values, affines = (work.value, work.value_2), (work.affine, work.affine_2)
    scatter_blocks(work.both, values, affines, setting, work, thread, n_threads)
    update_grid_vjp(setting, conditions, work, thread, n_threads)
    barrier(work.arrivals, n_threads)
    if thread == 0:
        add_friction_bar(coefficient_bar, work)
    momentum_of_each_vjp(
        pairs, q, q_bar, fields, fields_bar, drive_bar.push, ahead, q_before, drive.push, setting, work, thread,
        n_threads,
    )  # fmt: skip
    if drive.push.shape[0] > 0:
        barrier(work.arrivals, n_threads)
        if thread == 0:
            push_particles_vjp(drive, drive_bar, control, q, q_bar, fields, fields_bar)


@kernel
def advance(
    begin: int, end: int, keep: bool, groups: Any, conditions: Any, states: Array, fields: Array, drive: Drive,
    probe: Probe, records: Array, setting: Setting, work: Work, thread: int, n_threads: int,
) -> int:  # fmt: skip
    """Run substeps begin .. end from states[0]; return the substep reached.

    With `keep`, states[k] becomes the state after k substeps; without, states[0] moves along. Stops early
    when a particle is astray (`work.stray`). The state at the end of every control step is recorded.
    """
    for step in range(begin, end):
        here = step - begin if keep else 0
        q, q_next = states[here], states[here + 1] if keep else states[here]
        if step % setting.substeps == 0 or step == begin:
            if thread == 0:
                activate(drive, step // setting.substeps)
            barrier(work.arrivals, n_threads)
        begun, ahead = step > begin and follows(step, setting), step + 1 < end and follows(step + 1, setting)
        substep(step, begun, ahead, groups, conditions, q, q_next, fields, drive, setting, work, thread, n_threads)
        barrier(work.arrivals, n_threads)
        for other in range(n_threads):
            if work.stray[other] >= 0:
                return step + 1
        if (step + 1) % setting.substeps == 0 and thread == 0:
            record(probe, q_next, records[(step + 1) // setting.substeps])
    return end


@kernel
def reverse(
    begin: int, end: int, groups: Any, pairs: Any, conditions: Any, coefficient_bar: Array, states: Array,
    q_bar: Array, fields: Array, fields_bar: Array, drive: Drive, drive_bar: Drive, stresses: Any, probe: Probe,
    records_bar: Array, setting: Setting, work: Work, thread: int, n_threads: int,
) -> None:  # fmt: skip
    """Run the adjoints of substeps end - 1 .. begin; states[k] is the state of substep begin + k.

    Args:
        pairs, stresses: the groups, and the drive's stresses, each with its cotangent.
    """
    for step in range(end - 1, begin - 1, -1):
        q, q_next = states[step - begin], states[step - begin + 1]
        control = step // setting.substeps
        if (step + 1) % setting.substeps == 0 or step == end - 1:
            if thread == 0:
                activate(drive, control)
                if (step + 1) % setting.substeps == 0:
                    record_vjp(probe, q_bar, records_bar[control + 1])
            barrier(work.arrivals, n_threads)
        # sorted where a forward run counted down would be: at the chunk's start and every SORT_EVERY
        due = 0 if step == end - 1 or (step + 1) % SORT_EVERY == 0 else 1
        begun, ahead = step + 1 < end and follows(step + 1, setting), step > begin and follows(step, setting)
        q_before = states[step - begin - 1] if ahead else q
        substep_vjp(
            due, begun, ahead, control, groups, pairs, conditions, coefficient_bar, q_before, q, q_next, q_bar, fields,
            fields_bar, drive, drive_bar, setting, work, thread, n_threads,
        )  # fmt: skip
        barrier(work.arrivals, n_threads)
        if step % setting.substeps == 0 and thread == 0:
            activate_vjp(drive, drive_bar, stresses, control)
        barrier(work.arrivals, n_threads)
