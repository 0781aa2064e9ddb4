"""The passes that equilibrium needs, on all threads: net forces, their tangent, its product, and the adjoint."""

from __future__ import annotations

from typing import Any

from cqrun.engine.drive import activate_vjp
from cqrun.engine.exert import exert_of_each_vjp
from cqrun.engine.reference.forces import pull_each, pull_each_vjp, share_out
from cqrun.engine.reference.ghost import haunt_each, haunt_each_vjp
from cqrun.engine.reference.look import look
from cqrun.engine.reference.outside import clear_nodes, spread_forces_vjp
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep, Points
from cqrun.engine.reference.sweep import press_each, press_each_vjp
from cqrun.engine.setting import Crew, Drive
from cqrun.engine.statics.tangent import find_tangent_each, stiffen
from cqrun.forces.force import Levels
from cqrun.forces.pulled import Pulled
from cqrun.numerics.compile import barrier, for_each, kernel, share
from cqrun.numerics.records import load4, store4
from cqrun.plugin.contract import Array


@kernel
def find_net(
    parts: Any, loads: Any, ghosts: Any, drive: Drive, run: NodeRun, colours: Array, u: Array, still: Array,
    control: int, crew: Crew,
) -> None:  # fmt: skip
    """Write the forces on all nodes but the constant ones to `run.force`; `still` are velocities of zero."""
    clear_nodes(run.force, run, crew)
    press_each(parts, run, u, still, colours, False, crew)
    pull_each(loads, drive, run, NodeStep(control, u, still, still), crew)
    haunt_each(ghosts, run, u, crew)


@kernel
def find_slopes(parts: Any, run: NodeRun, A: Array, u: Array, still: Array, colours: Array, crew: Crew) -> None:
    """Write the particles' tangents at u to A, and their places to `run.q`."""
    look(run, u, still, crew)
    find_tangent_each(parts, run, A, u, colours, crew)
    barrier(run.arrivals, crew.n_threads)


@kernel
def find_change(
    loads: Any, ghosts: Any, drive: Drive, run: NodeRun, A: Array, push: Array, colours: Array, p: Array, control: int,
    crew: Crew,
) -> None:  # fmt: skip
    """Write the change of the forces with a displacement p to `run.force`, at the state of `find_slopes`."""
    clear_nodes(run.force, run, crew)
    stiffen(run, A, p, colours, crew)
    pull_change_each(loads, drive, run, push, p, control, crew)
    haunt_each(ghosts, run, p, crew)


@kernel
def pull_change(
    pair: tuple[Points, Pulled], drive: Drive, run: NodeRun, push: Array, p: Array, control: int, crew: Crew
) -> None:
    """Add the change of the forces on points; their tangent is symmetric, so their adjoint gives it."""
    points, pulled = pair
    width = push.shape[2]
    lo, hi = share(len(points.columns), crew.thread, crew.n_threads)
    for j in range(lo, hi):
        at = points.columns[j]
        for d in range(push.shape[1]):
            total = 0.0
            for k in range(points.node.shape[1]):
                total += points.weight[j, k] * p[points.node[j, k], d]
            push[at // width, d, at % width] = total
    barrier(run.arrivals, crew.n_threads)
    exert_of_each_vjp(drive.forces, drive.levels, control, run.q, push, crew)
    barrier(run.arrivals, crew.n_threads)
    share_out(points, pulled, pulled.shares.x_bar, run.force, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)


pull_change_each = for_each(pull_change)


@kernel
def find_bars(
    pairs: Any, loads: Any, ghosts: Any, drive: Drive, stresses: Any, levels_bar: Levels, run: NodeRun,
    bars: NodeBars, colours: Array, u: Array, still: Array, adjoint: Array, control: int, crew: Crew,
) -> None:  # fmt: skip
    """Add to the cotangents of everything that the forces at u depend on, for a cotangent `adjoint` of the forces.

    Afterwards bars.sums has, at each node, the cotangent of its displacement.
    """
    lo, hi = share(len(run.nodes.active), crew.thread, crew.n_threads)
    for index in range(lo, hi):
        n = run.nodes.active[index]
        store4(bars.pairs, 2 * n, load4(u, n))
        store4(bars.pairs, 2 * n + 1, load4(adjoint, n))
        store4(bars.outside, n, load4(adjoint, n))
        store4(bars.sums, 2 * n, 0.0)
        store4(bars.sums, 2 * n + 1, 0.0)
    barrier(run.arrivals, crew.n_threads)
    press_each_vjp(pairs, run, bars, still, colours, crew)
    pull_each_vjp(loads, drive, levels_bar, run, bars, NodeStep(control, u, still, still), crew)
    haunt_each_vjp(ghosts, run, bars, crew)
    spread_forces_vjp(run, bars, crew)
    if crew.thread == 0:
        activate_vjp(stresses, drive, levels_bar, run.fields, bars.fields, bars.steady, control)
    barrier(run.arrivals, crew.n_threads)
