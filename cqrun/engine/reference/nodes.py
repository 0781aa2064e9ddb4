"""The passes over nodes of a substep and of its adjoint; inactive nodes stay at zero.

    v' = project((kept v + dt f) / m),    u' = u + dt v'

with the lumped mass m = sum_p w m_p and kept = sum_p w kappa m_p, kappa = exp(-damping dt). The step can be run
backwards: u = u' - dt v', v = project((m v' - dt f(u)) / kept).

Adjoint, with w = project_vjp(v'_bar + dt u'_bar):  p = f_bar = dt w / m,  u_bar = u'_bar + (adjoint of the forces),
v_bar = kept w / m + (that of rates),  kept_bar = w . v / m,  m_bar = -v'_bar . v' / m  (v' is linear in 1 / m).
"""

from __future__ import annotations

from typing import Any

from cqrun.boundaries.condition import project_all, project_all_vjp
from cqrun.engine.arrays import components, record_of
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import kernel, share
from cqrun.numerics.lanes import lane
from cqrun.numerics.records import load4, store4
from cqrun.plugin.contract import Array


@kernel
def product(a: Any, b: Any) -> Any:
    """Return the scalar product of two records' vectors."""
    c = a * b
    return lane(c, 0) + lane(c, 1) + lane(c, 2)


@kernel
def held(conditions: Any, run: NodeRun, node: int, v: Any) -> Any:
    """Return a node's velocity after its boundary conditions."""
    bits = run.nodes.bits[node]
    if bits != 0:
        after = project_all(conditions, node, bits, components(v, run.setting.dims))
        v = record_of(0.0, run.force, after)
    return v


@kernel
def kick(conditions: Any, run: NodeRun, at: NodeStep, u_next: Array, crew: Crew) -> None:
    """Move the nodes by a substep; clear the internal forces for the next."""
    nodes, dt = run.nodes, run.setting.dt
    lo, hi = share(len(nodes.active), crew.thread, crew.n_threads)
    for index in range(lo, hi):
        n = nodes.active[index]
        f = load4(run.force, n) + load4(run.outside, n)
        v = held(conditions, run, n, (load4(at.v, n) * nodes.kept[n] + f * dt) / nodes.mass[n])
        store4(at.v_next, n, v)
        store4(u_next, n, load4(at.u, n) + v * dt)
        store4(run.force, n, 0.0)


@kernel
def begin_vjp(
    conditions: Any, run: NodeRun, bars: NodeBars, at: NodeStep, u_next: Array, reversed_: bool, crew: Crew
) -> None:
    """Write the displacement and the cotangent of the force to `pairs`; if `reversed_`, find the displacement first."""
    nodes, dt = run.nodes, run.setting.dt
    lo, hi = share(len(nodes.active), crew.thread, crew.n_threads)
    for index in range(lo, hi):
        n = nodes.active[index]
        v, m, bits = load4(at.v_next, n), nodes.mass[n], nodes.bits[n]
        if reversed_:
            store4(at.u, n, load4(u_next, n) - v * dt)
        v_bar = load4(bars.v, n) + load4(bars.u, n) * dt
        bars.mass[n] -= product(v_bar, v) / m
        if bits != 0:
            before, after_bar = components(v, run.setting.dims), components(v_bar, run.setting.dims)
            before_bar = project_all_vjp(conditions, n, bits, before, after_bar, bars.friction, 0)
            v_bar = record_of(0.0, run.force, before_bar)
        store4(bars.v, n, v_bar)
        p = v_bar * dt / m
        store4(bars.outside, n, load4(bars.outside, n) + p)
        store4(bars.pairs, 2 * n, load4(at.u, n))
        store4(bars.pairs, 2 * n + 1, p)
        store4(bars.sums, 2 * n, 0.0)
        store4(bars.sums, 2 * n + 1, 0.0)


@kernel
def end_vjp(conditions: Any, run: NodeRun, bars: NodeBars, at: NodeStep, reversed_: bool, crew: Crew) -> None:
    """Finish the cotangents of the state before the substep; if `reversed_`, find the velocity first."""
    nodes, dt, rates = run.nodes, run.setting.dt, len(run.setting.rates) > 0
    lo, hi = share(len(nodes.active), crew.thread, crew.n_threads)
    for index in range(lo, hi):
        n = nodes.active[index]
        m, kept = nodes.mass[n], nodes.kept[n]
        more = load4(bars.sums, 2 * n + 1)
        if reversed_:
            f = more + load4(run.outside, n)
            store4(at.v, n, held(conditions, run, n, (load4(at.v_next, n) * m - f * dt) / kept))
        v_bar = load4(bars.v, n)
        bars.kept[n] += product(v_bar, load4(at.v, n)) / m
        v_bar = v_bar * (kept / m)
        store4(bars.v, n, v_bar + more if rates else v_bar)
        store4(bars.u, n, load4(bars.u, n) + load4(bars.sums, 2 * n))
