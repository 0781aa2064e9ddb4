"""The substeps of the reference frame, and their adjoints; every thread runs these loops.

A substep is one sweep over the particles (`sweep.py`), forces on points (`forces.py`) and one pass over the nodes
(`nodes.py`). The sweep updates histories of materials as well (`history.py`). Its adjoint is the same with two more
fields. A reversed run keeps no states: it finds the state before each substep from the one after it, which is
exact but for rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.engine.drive import activate, activate_vjp
from cqrun.engine.probe import record, record_vjp
from cqrun.engine.reference.contacts import Contacts, touch_all, touch_all_vjp, touch_rates_all_vjp
from cqrun.engine.reference.forces import pull_each, pull_each_vjp
from cqrun.engine.reference.ghost import haunt_each, haunt_each_vjp
from cqrun.engine.reference.history import keep_each, recall_each
from cqrun.engine.reference.look import look, look_vjp
from cqrun.engine.reference.moves import bring_back_pairs, carry_each, carry_each_vjp
from cqrun.engine.reference.nodes import begin_vjp, end_vjp, kick
from cqrun.engine.reference.outside import spread_forces, spread_forces_vjp
from cqrun.engine.reference.placing import note_all_poses_each, note_all_poses_each_vjp
from cqrun.engine.reference.reactions import (
    add_up_each,
    before_each_vjp,
    clear_sums_each,
    forces_each_vjp,
    impulses_each_vjp,
    note_before_each,
    note_impulses_each,
)
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep
from cqrun.engine.reference.stretch import WATCH, watch
from cqrun.engine.reference.sweep import press_each, press_each_vjp
from cqrun.engine.setting import Crew, Drive, Probe
from cqrun.forces.force import Levels
from cqrun.numerics.compile import barrier, kernel, share
from cqrun.plugin.contract import Array


@kernel
def begin_control(drive: Drive, run: NodeRun, colours: Array, control: int, crew: Crew) -> None:
    """Set the active stresses and the external forces of a control step."""
    if crew.thread == 0:
        activate(drive, run.fields, run.push, control)
    barrier(run.arrivals, crew.n_threads)
    spread_forces(run, colours, crew)


@kernel
def find_stray(run: NodeRun, u: Array, crew: Crew) -> None:
    """Note the first node whose displacement is not finite, on one thread."""
    if crew.thread == 0:
        for n in run.nodes.active:
            if not np.isfinite(u[n, 0] + u[n, 1] + u[n, 2]):
                run.stray[0] = n
                break
    barrier(run.arrivals, crew.n_threads)


@kernel
def advance(
    parts: Any, histories: Any, conditions: Any, loads: Any, ghosts: Any, moves: Any, reactions: Any,
    contacts: Contacts, drive: Drive, run: NodeRun, colours: Array, states: Array, begin: int, end: int, keep: bool,
    probe: Probe, records: Array, crew: Crew,
) -> int:  # fmt: skip
    """Run substeps begin .. end from states[0]; return the substep reached.

    With `keep`, states[k] becomes the state after k substeps; otherwise states[0] is overwritten. A state has the
    displacements and the velocities of the nodes, after them the springs of contact, the rigid bodies that move freely
    and the impulses of reactions, and then the histories, (2, M + E + H, 4). Record at the end of every control step.
    Stop there, or every WATCH substeps, if a node is not finite (`run.stray`).

    Args:
        parts: groups with their first and last bodies.
        histories: those of materials, or none.
        loads: forces on points, as in `forces.py`.
        ghosts: the ghost penalty, or none.
        moves: the nodes of boundaries that move, or none.
        reactions: what boundaries do to the bodies, or none.
        contacts: what bodies touch.
    """
    substeps = run.setting.substeps
    recall_each(histories, run, run.q, states[0, 0], states[0, 1], crew)
    for step in range(begin, end):
        here = step - begin if keep else 0
        after = here + 1 if keep else 0
        control = step // substeps
        if step % substeps == 0 or step == begin:
            begin_control(drive, run, colours, control, crew)
            clear_sums_each(reactions, run, step, crew)
        u, v = states[here, 0], states[here, 1]
        at = NodeStep(control, u, v, states[after, 1])
        press_each(parts, run, u, v, colours, crew)
        pull_each(loads, drive, run, at, crew)
        haunt_each(ghosts, run, u, crew)
        touch_all(contacts, run, at, states[after, 0], step, keep, crew)
        note_before_each(reactions, run, at, crew)
        kick(conditions, run, at, states[after, 0], crew)
        barrier(run.arrivals, crew.n_threads)
        carry_each(moves, run, u, states[after, 0], states[after, 1], step, crew)
        note_impulses_each(reactions, run, at, states[after, 0], step, keep, crew)
        ends, looks = (step + 1) % substeps == 0, (step + 1) % WATCH == 0
        if keep or step + 1 == end:
            keep_each(histories, run, run.q, states[after, 0], states[after, 1], crew)
        if ends:
            add_up_each(reactions, run, step, crew)
        if ends or looks:
            find_stray(run, states[after, 0], crew)
            if run.stray[0] >= 0:
                return step + 1
            if ends:
                note(run, states[after, 0], states[after, 1], probe, records[control + 1], crew)
                note_all_poses_each(contacts.obstacles, run, states[after, 0], states[after, 1], step + 1, crew)
            else:
                look(run, states[after, 0], states[after, 1], crew)
            watch(run, step + 1, crew)
    return end


@kernel
def note(run: NodeRun, u: Array, v: Array, probe: Probe, row: Array, crew: Crew) -> None:
    """Record a state of the nodes."""
    look(run, u, v, crew)
    if crew.thread == 0:
        record(probe, run.q, row)
    barrier(run.arrivals, crew.n_threads)


@kernel
def note_vjp(
    run: NodeRun, bars: NodeBars, colours: Array, u: Array, v: Array, probe: Probe, row_bar: Array, u_bar: Array,
    v_bar: Array, crew: Crew,
) -> None:  # fmt: skip
    """Add the adjoint of `note` to the cotangents of the state."""
    some = False
    for k in range(row_bar.shape[0]):
        for j in range(row_bar.shape[1]):
            some = some or row_bar[k, j] != 0.0
    if some:
        if crew.thread == 0:
            record_vjp(probe, bars.q, row_bar)
        barrier(run.arrivals, crew.n_threads)
        see_vjp(run, bars, colours, u, v, u_bar, v_bar, crew)


@kernel
def see_vjp(
    run: NodeRun, bars: NodeBars, colours: Array, u: Array, v: Array, u_bar: Array, v_bar: Array, crew: Crew
) -> None:
    """Add the adjoint of `look` at bars.q to the cotangents of the state; clear bars.q, but not the histories."""
    lo, hi = share(len(run.nodes.active), crew.thread, crew.n_threads)
    for index in range(lo, hi):
        n = run.nodes.active[index]
        for d in range(4):
            bars.pairs[2 * n, d] = bars.pairs[2 * n + 1, d] = 0.0
    barrier(run.arrivals, crew.n_threads)
    look_vjp(run, bars, bars.pairs, colours, u, v, crew)
    for index in range(lo, hi):
        n = run.nodes.active[index]
        for d in range(4):
            u_bar[n, d] += bars.pairs[2 * n, d]
            v_bar[n, d] += bars.pairs[2 * n + 1, d]
    lo, hi = share(bars.q.shape[0], crew.thread, crew.n_threads)
    dim = len(run.setting.dims)
    for i in range(lo, hi):
        for row in range(2 * dim * (1 + dim)):  # x, v, C and F
            for k in range(bars.q.shape[2]):
                bars.q[i, row, k] = 0.0
    barrier(run.arrivals, crew.n_threads)


@kernel
def reverse(
    pairs: Any, histories: Any, conditions: Any, loads: Any, ghosts: Any, moves: Any, reactions: Any,
    contacts: Contacts, drive: Drive, stresses: Any, levels_bar: Levels, run: NodeRun, bars: NodeBars, colours: Array,
    states: Array, begin: int, end: int, reversed_: bool, probe: Probe, records_bar: Array, crew: Crew,
) -> None:  # fmt: skip
    """Run the adjoints of substeps end - 1 .. begin.

    states[k] is the state of substep begin + k; if `reversed_`, states[0] is that of substep `end`, and becomes that of
    `begin`. `pairs`, `histories`, `moves`, `reactions` and `stresses` are the parts, the histories and so on, each with
    its cotangent.
    """
    substeps = run.setting.substeps
    recall_each(histories, run, bars.q, bars.u, bars.v, crew)
    for step in range(end - 1, begin - 1, -1):
        here = 0 if reversed_ else step - begin
        after = 0 if reversed_ else here + 1
        control = step // substeps
        if (step + 1) % substeps == 0:
            u, v = states[after, 0], states[after, 1]
            note_vjp(run, bars, colours, u, v, probe, records_bar[control + 1], bars.u, bars.v, crew)
            note_all_poses_each_vjp(contacts.obstacles, run, bars, u, v, step + 1, crew)
        if (step + 1) % substeps == 0 or step == end - 1:
            begin_control(drive, run, colours, control, crew)
        at = NodeStep(control, states[here, 0], states[here, 1], states[after, 1])
        recall_each(histories, run, run.q, at.u, at.v, crew)
        impulses_each_vjp(reactions, run, bars, at, states[after, 0], reversed_, crew)
        carry_each_vjp(moves, run, bars, step, crew)
        begin_vjp(conditions, run, bars, at, states[after, 0], reversed_, crew)
        barrier(run.arrivals, crew.n_threads)
        forces_each_vjp(reactions, run, bars, crew)
        press_each_vjp(pairs, run, bars, at.v, colours, crew)
        pull_each_vjp(loads, drive, levels_bar, run, bars, at, crew)
        haunt_each_vjp(ghosts, run, bars, crew)
        touch_all_vjp(contacts, run, bars, at, step, reversed_, crew)
        end_vjp(conditions, run, bars, at, reversed_, crew)
        barrier(run.arrivals, crew.n_threads)
        if reversed_:
            bring_back_pairs(moves, run, at.v, step, crew)
        touch_rates_all_vjp(contacts, run, bars, crew)
        before_each_vjp(reactions, run, bars, at, states[after, 0], reversed_, crew)
        if step % substeps == 0 or step == begin:
            spread_forces_vjp(run, bars, crew)
            if crew.thread == 0:
                activate_vjp(stresses, drive, levels_bar, run.fields, bars.fields, bars.steady, control)
            barrier(run.arrivals, crew.n_threads)
    keep_each(histories, run, bars.q, bars.u, bars.v, crew)
