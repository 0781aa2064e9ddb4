"""The substep as a list of passes, and its adjoint, that list reversed; the loops over substeps.

Every thread runs these loops with its own number and meets the others after each pass (`compile.py`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import overload

from cqrun.compile import barrier, kernel, share
from cqrun.contract import Array
from cqrun.engine.blocks import SORT_EVERY, sort_particles
from cqrun.engine.grid import add_friction_bar, clear, update_grid, update_grid_vjp
from cqrun.engine.muscles import activate, activate_vjp
from cqrun.engine.particles import momentum, momentum_vjp, move, move_vjp
from cqrun.engine.probe import record, record_vjp
from cqrun.engine.setting import Muscles, Probe, Setting, Work
from cqrun.engine.transfer import scatter

MAX_TRAVEL = 0.99
"""Cells that a particle may move before particles are sorted again (`blocks.py`: one, less round-off)."""


@kernel
def scatter_blocks(
    grid: Array, value: Array, affine: Array, setting: Setting, work: Work, thread: int, n_threads: int
) -> None:
    """Scatter all particles, colour by colour."""
    blocks = work.blocks
    for colour in range(8):
        begin, n_work = blocks.colour[colour], blocks.colour[colour + 1] - blocks.colour[colour]
        if n_work > 0:
            lo, hi = share(n_work, thread, n_threads)
            for index in range(begin + lo, begin + hi):
                block = blocks.work[index]
                first, last = blocks.start[block], blocks.start[block + 1]
                scatter(grid, value, affine, work.place, blocks.order, first, last, setting.strides, setting.dims)
            barrier(work.barrier, n_threads)


def momentum_of_all(groups: Any, q: Array, fields: Array, setting: Any, work: Any, thread: int, n: int) -> None:
    """Run `momentum` for every body."""
    for group in groups:
        momentum(group, q, fields, setting, work, thread, n)


def move_all(groups: Any, q: Array, q_next: Array, setting: Any, work: Any, thread: int, n: int) -> None:
    """Run `move` for every body."""
    for group in groups:
        move(group, q, q_next, setting, work, thread, n)


def move_all_vjp(
    groups: Any, q: Array, q_next: Array, q_bar: Array, setting: Any, work: Any, thread: int, n: int
) -> None:
    """Run `move_vjp` for every body."""
    for group in groups:
        move_vjp(group, q, q_next, q_bar, setting, work, thread, n)


def momentum_of_all_vjp(
    groups: Any, groups_bar: Any, q: Array, q_bar: Array, fields: Array, fields_bar: Array,
    setting: Any, work: Any, thread: int, n: int,
) -> None:  # fmt: skip
    """Run `momentum_vjp` for every body."""
    for group, group_bar in zip(groups, groups_bar, strict=True):
        momentum_vjp(group, group_bar, q, q_bar, fields, fields_bar, setting, work, thread, n)


@overload(momentum_of_all)
def _momentum_of_all(groups, q, fields, setting, work, thread, n):
    if len(groups) == 0:
        return lambda groups, q, fields, setting, work, thread, n: None

    def several(groups, q, fields, setting, work, thread, n):
        momentum(groups[0], q, fields, setting, work, thread, n)
        momentum_of_all(groups[1:], q, fields, setting, work, thread, n)

    return several


@overload(move_all)
def _move_all(groups, q, q_next, setting, work, thread, n):
    if len(groups) == 0:
        return lambda groups, q, q_next, setting, work, thread, n: None

    def several(groups, q, q_next, setting, work, thread, n):
        move(groups[0], q, q_next, setting, work, thread, n)
        move_all(groups[1:], q, q_next, setting, work, thread, n)

    return several


@overload(move_all_vjp)
def _move_all_vjp(groups, q, q_next, q_bar, setting, work, thread, n):
    if len(groups) == 0:
        return lambda groups, q, q_next, q_bar, setting, work, thread, n: None

    def several(groups, q, q_next, q_bar, setting, work, thread, n):
        move_vjp(groups[0], q, q_next, q_bar, setting, work, thread, n)
        move_all_vjp(groups[1:], q, q_next, q_bar, setting, work, thread, n)

    return several


@overload(momentum_of_all_vjp)
def _momentum_of_all_vjp(groups, groups_bar, q, q_bar, fields, fields_bar, setting, work, thread, n):
    if len(groups) == 0:
        return lambda groups, groups_bar, q, q_bar, fields, fields_bar, setting, work, thread, n: None

    def several(groups, groups_bar, q, q_bar, fields, fields_bar, setting, work, thread, n):
        momentum_vjp(groups[0], groups_bar[0], q, q_bar, fields, fields_bar, setting, work, thread, n)
        momentum_of_all_vjp(groups[1:], groups_bar[1:], q, q_bar, fields, fields_bar, setting, work, thread, n)

    return several


@kernel
def sort_if_due(step: int, setting: Setting, work: Work, thread: int, n_threads: int) -> None:
    """Sort particles where the last sort no longer serves; one thread, between two barriers."""
    barrier(work.barrier, n_threads)
    if thread == 0:
        blocks = work.blocks
        fastest = 0.0
        for other in range(n_threads):
            fastest = max(fastest, work.speed[other])
            work.speed[other] = 0.0
        blocks.travel[0] += np.sqrt(fastest) * setting.dt / setting.dx
        if step % SORT_EVERY == 0 or not blocks.travel[0] < MAX_TRAVEL:
            sort_particles(blocks, work.place)
    barrier(work.barrier, n_threads)


@kernel
def particles_to_grid(
    step: int, groups: Any, conditions: Any, q: Array, fields: Array, setting: Setting, work: Work,
    thread: int, n_threads: int,
) -> None:  # fmt: skip
    """The first half of a substep: grid velocities from the state q."""
    momentum_of_all(groups, q, fields, setting, work, thread, n_threads)
    sort_if_due(step, setting, work, thread, n_threads)
    clear(work.grid, setting, work, thread, n_threads)
    barrier(work.barrier, n_threads)
    scatter_blocks(work.grid, work.value, work.affine, setting, work, thread, n_threads)
    update_grid(setting, conditions, work, thread, n_threads)
    barrier(work.barrier, n_threads)


@kernel
def substep(
    step: int, groups: Any, conditions: Any, q: Array, q_next: Array, fields: Array, setting: Setting,
    work: Work, thread: int, n_threads: int,
) -> None:  # fmt: skip
    """q_next = one substep from q."""
    particles_to_grid(step, groups, conditions, q, fields, setting, work, thread, n_threads)
    move_all(groups, q, q_next, setting, work, thread, n_threads)


@kernel
def substep_vjp(
    step: int, groups: Any, groups_bar: Any, conditions: Any, coefficient_bar: Array, q: Array, q_next: Array,
    q_bar: Array, fields: Array, fields_bar: Array, setting: Setting, work: Work, thread: int, n_threads: int,
) -> None:  # fmt: skip
    """Turn q_bar from the cotangent of q_next into that of q; add to those of the parameters."""
    move_all_vjp(groups, q, q_next, q_bar, setting, work, thread, n_threads)
    particles_to_grid(step, groups, conditions, q, fields, setting, work, thread, n_threads)
    clear(work.grid_bar, setting, work, thread, n_threads)
    barrier(work.barrier, n_threads)
    scatter_blocks(work.grid_bar, work.value_2, work.affine_2, setting, work, thread, n_threads)
    update_grid_vjp(setting, conditions, work, thread, n_threads)
    barrier(work.barrier, n_threads)
    if thread == 0:
        add_friction_bar(coefficient_bar, work)
    momentum_of_all_vjp(groups, groups_bar, q, q_bar, fields, fields_bar, setting, work, thread, n_threads)


@kernel
def advance(
    begin: int, end: int, keep: bool, groups: Any, conditions: Any, states: Array, fields: Array, muscles: Muscles,
    probe: Probe, records: Array, setting: Setting, work: Work, thread: int, n_threads: int,
) -> int:  # fmt: skip
    """Run substeps begin .. end from states[0]; return the substep reached.

    With `keep`, states[k] becomes the state after k substeps; without, states[0] moves along. Stops early
    when a particle is astray (`work.stray`). Every control step is recorded at its beginning, and the last
    state by the caller.
    """
    for step in range(begin, end):
        here = step - begin if keep else 0
        q, q_next = states[here], states[here + 1] if keep else states[here]
        if step % setting.substeps == 0 or step == begin:
            control = step // setting.substeps
            if thread == 0:
                activate(muscles, control)
                if step % setting.substeps == 0:
                    record(probe, q, records[control])
            barrier(work.barrier, n_threads)
        substep(step, groups, conditions, q, q_next, fields, setting, work, thread, n_threads)
        barrier(work.barrier, n_threads)
        for other in range(n_threads):
            if work.stray[other] >= 0:
                return step + 1
    return end


@kernel
def reverse(
    begin: int, end: int, groups: Any, groups_bar: Any, conditions: Any, coefficient_bar: Array, states: Array,
    q_bar: Array, fields: Array, fields_bar: Array, muscles: Muscles, muscles_bar: Muscles, probe: Probe,
    records_bar: Array, setting: Setting, work: Work, thread: int, n_threads: int,
) -> None:  # fmt: skip
    """Run the adjoints of substeps end - 1 .. begin; states[k] is the state of substep begin + k."""
    for step in range(end - 1, begin - 1, -1):
        q, q_next = states[step - begin], states[step - begin + 1]
        control = step // setting.substeps
        if (step + 1) % setting.substeps == 0 or step == end - 1:
            if thread == 0:
                activate(muscles, control)
            barrier(work.barrier, n_threads)
        # sorted where a forward run counted down would be: at the chunk's start and every SORT_EVERY
        due = 0 if step == end - 1 or (step + 1) % SORT_EVERY == 0 else 1
        substep_vjp(
            due, groups, groups_bar, conditions, coefficient_bar, q, q_next, q_bar, fields, fields_bar,
            setting, work, thread, n_threads,
        )  # fmt: skip
        if step % setting.substeps == 0:
            barrier(work.barrier, n_threads)
            if thread == 0:
                activate_vjp(muscles, muscles_bar, control)
                record_vjp(probe, q_bar, records_bar[control])
        barrier(work.barrier, n_threads)
