"""The passes that equilibrium needs, on all threads: net forces, their tangent, its product, and the adjoint."""

from __future__ import annotations

from typing import Any

from cqrun.engine.drive import activate_vjp
from cqrun.engine.exert import exert_of_each_jvp, exert_of_each_vjp
from cqrun.engine.reference.forces import place_points_each, pull_each, pull_each_vjp, share_out, spread_to_points
from cqrun.engine.reference.ghost import haunt_each, haunt_each_vjp
from cqrun.engine.reference.look import look
from cqrun.engine.reference.outside import clear_nodes, spread_forces_vjp
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep, PointLoads
from cqrun.engine.reference.sweep import press_each, press_each_vjp
from cqrun.engine.setting import Crew, Drive
from cqrun.engine.statics.tangent import find_tangent_each, stiffen
from cqrun.forces.force import Levels
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
    press_each(parts, run, u, still, colours, crew)
    pull_each(loads, drive, run, NodeStep(control, u, still, still), crew)
    haunt_each(ghosts, run, u, crew)


@kernel
def find_slopes(
    parts: Any, loads: Any, run: NodeRun, A: Array, u: Array, still: Array, colours: Array, crew: Crew
) -> None:
    """Write the particles' tangents at u to A, their places to `run.q`, and those of points to their tables."""
    look(run, u, still, crew)
    place_points_each(loads, run, u, 1, still, crew)
    find_tangent_each(parts, run, A, u, colours, crew)
    barrier(run.arrivals, crew.n_threads)


@kernel
def find_change(
    loads: Any, ghosts: Any, drive: Drive, run: NodeRun, A: Array, colours: Array, p: Array, control: int, crew: Crew
) -> None:
    """Write the change of the forces with a displacement p to `run.force`, at the state of `find_slopes`."""
    clear_nodes(run.force, run, crew)
    stiffen(run, A, p, colours, crew)
    pull_change_each(loads, drive, run, p, control, crew)
    haunt_each(ghosts, run, p, crew)


@kernel
def find_change_vjp(
    loads: Any, ghosts: Any, drive: Drive, run: NodeRun, A: Array, colours: Array, p: Array, control: int, crew: Crew
) -> None:
    """Write the product of p with the transposed matrix of `find_change`; only forces on points make it another one."""
    clear_nodes(run.force, run, crew)
    stiffen(run, A, p, colours, crew)
    pull_change_each_vjp(loads, drive, run, p, control, crew)
    haunt_each(ghosts, run, p, crew)


@kernel
def pull_change(load: PointLoads, drive: Drive, run: NodeRun, p: Array, control: int, crew: Crew) -> None:
    """Add the change of the forces on points; where their tangent is symmetric, their adjoint gives it."""
    spread_to_points(load, p, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)
    exert_of_each_jvp(drive.forces, drive.levels, control, load.q, load.push, crew)
    share_change(load, run, crew)


@kernel
def pull_change_vjp(load: PointLoads, drive: Drive, run: NodeRun, p: Array, control: int, crew: Crew) -> None:
    """Add the product of p with the transposed tangent of the forces on points."""
    spread_to_points(load, p, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)
    exert_of_each_vjp(drive.forces, drive.levels, control, load.q, load.push, crew)
    share_change(load, run, crew)


@kernel
def share_change(load: PointLoads, run: NodeRun, crew: Crew) -> None:
    """Add what a pass over all forces on points has written to the nodes."""
    barrier(run.arrivals, crew.n_threads)
    share_out(load.points, load.pulled, load.pulled.shares.x_bar, run.force, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)


pull_change_each, pull_change_each_vjp = for_each(pull_change), for_each(pull_change_vjp)


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
