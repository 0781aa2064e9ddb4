"""Passes that apply forces to particles, and their adjoints, on all threads.

In each substep the threads first share the items of forces (`forces/force.py`), then the lanes with pulled particles.
For each such lane they sum the shares of every particle and write the lane's momentum with its force. So the other
lanes do not wait for the forces. `drive.py` sets steady forces (`forces/steady.py`) once per control step.
"""

from __future__ import annotations

from typing import Any

from cqrun.engine.arrays import first_row_of_v
from cqrun.engine.exert import add_level_bars_of_each, exert_of_each, exert_of_each_vjp
from cqrun.engine.setting import Crew, Drive, Group
from cqrun.engine.updated.particles import begin_cotangent, write_momentum
from cqrun.engine.updated.setting import Bars, Run, Substep
from cqrun.forces.force import Levels
from cqrun.forces.pulled import Pulled
from cqrun.numerics.compile import barrier, for_each, kernel, share
from cqrun.numerics.lanes import LANE_BYTES
from cqrun.state import X


@kernel
def push_lanes(group: Group, pulled: Pulled, run: Run, at: Substep, crew: Crew) -> None:
    """Set the force on a group's pulled particles, and write the momentum of their lanes."""
    lanes, force, width, push = group.pulled[0], pulled.shares.force, LANE_BYTES // at.q.itemsize, run.push
    lo, hi = share(len(lanes.first), crew.thread, crew.n_threads)
    for index in range(lo, hi):
        for j in range(lanes.begin[index], lanes.begin[index + 1]):
            p = pulled.columns[j]
            for d in range(push.shape[1]):
                push[p // width, d, p % width] = pulled.base[j, d]
                for s in range(pulled.begin[j], pulled.begin[j + 1]):
                    push[p // width, d, p % width] += force[pulled.order[s], d]
        first = lanes.first[index]
        write_momentum(group, run, at.q, at.q_next, first, first + width)


@kernel
def push_lanes_vjp(groups: tuple[Group, Group], pulled: Pulled, run: Run, bars: Bars, at: Substep, crew: Crew) -> None:
    """Add the forces' part to the cotangents of their particles; if `ahead`, start the previous substep's adjoint."""
    lanes, q_bar, shares = groups[0].pulled[0], bars.q, pulled.shares
    width, V = LANE_BYTES // at.q.itemsize, first_row_of_v(run.setting.dims)
    lo, hi = share(len(lanes.first), crew.thread, crew.n_threads)
    for index in range(lo, hi):
        for j in range(lanes.begin[index], lanes.begin[index + 1]):
            p = pulled.columns[j]
            for d in range(shares.force.shape[1]):
                for s in range(pulled.begin[j], pulled.begin[j + 1]):
                    q_bar[p // width, X + d, p % width] += shares.x_bar[pulled.order[s], d]
                    q_bar[p // width, V + d, p % width] += shares.v_bar[pulled.order[s], d]
        if at.ahead:
            first = lanes.first[index]
            begin_cotangent(groups[0], run, at.q_before, at.q, q_bar, first, first + width, crew.thread)


push_lanes_of_each = for_each(push_lanes)
push_lanes_of_each_vjp = for_each(push_lanes_vjp)


@kernel
def push(pulled: Pulled, groups: Any, drive: Drive, run: Run, at: Substep, crew: Crew) -> None:
    """Apply all forces at the state q."""
    exert_of_each(drive.forces, drive.levels, at.control, at.q, crew)
    barrier(run.work.arrivals, crew.n_threads)
    push_lanes_of_each(groups, pulled, run, at, crew)


@kernel
def push_vjp(
    pulled: Pulled, pairs: Any, drive: Drive, levels_bar: Levels, run: Run, bars: Bars, at: Substep, crew: Crew
) -> None:
    """Add to the cotangents of the state and of the levels from that of the forces (`bars.push`)."""
    barrier(run.work.arrivals, crew.n_threads)
    exert_of_each_vjp(drive.forces, drive.levels, at.control, at.q, bars.push, crew)
    barrier(run.work.arrivals, crew.n_threads)
    push_lanes_of_each_vjp(pairs, pulled, run, bars, at, crew)
    if crew.thread == 0:
        add_level_bars_of_each(drive.forces, levels_bar, at.control)


push_if_pulled = for_each(push)
push_if_pulled_vjp = for_each(push_vjp)
