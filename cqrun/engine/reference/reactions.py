"""Reactions in motion: the mean force and moment with which each boundary acts on the bodies, in each control step.

A node n that a boundary holds would have the momentum p_n = kept v + dt f after a substep. The boundary changes it to
m v', and so gives the node the impulse

    J_n = W_n (m v' - (kept v + dt f)),    F = 1 / (S dt) sum J_n,    M = 1 / (S dt) sum a_n x J_n

with the sums over the nodes of a boundary and the S substeps of a control step. W_n is the part of the node's impulse
that the boundary takes, 1 if it is alone there (statics/holding.py), and a_n = X_n + u_n - C the arm before the
substep, from the centre C of all that the boundary holds at rest. With this arm the angular momentum is balanced
exactly, as the momentum is. An obstacle acts on surface points instead (`touch.py`): F = 1 / S sum f_s and M = 1 / S
sum x_s x f_s, about the origin of the world, because what it touches changes.

Each thread adds up the impulses of its own nodes and points. One thread adds these sums at the end of a control step,
in order, so that the result does not depend on the number of threads.

Adjoint, for the cotangents F_bar and M_bar of a control step, divided by S dt:

    J_bar = W^T (F_bar + M_bar x a),  v'_bar += m J_bar,  f_bar -= dt J_bar,  v_bar -= kept J_bar,  u_bar += J x M_bar,
    m_bar += v' . J_bar,  kept_bar -= v . J_bar

It needs J itself for nodes whose arm may change: a run that keeps states keeps these J with them, as rows of a state;
a run that is reversed finds J from the force that it computes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.boundaries.solid import cross
from cqrun.engine.model import Model
from cqrun.engine.reference.contact import REACTION, Contact, Pushes, in_3d
from cqrun.engine.reference.facet import row
from cqrun.engine.reference.movers import load_spring, put, store_spring
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep
from cqrun.engine.setting import Crew
from cqrun.engine.statics.reactions import holders
from cqrun.numerics.compile import barrier, for_each, kernel, own_symbols, share
from cqrun.numerics.tensor import add, scale, sub
from cqrun.plugin.contract import Array


class Reactions(NamedTuple):
    """What boundaries hold and touch, and how much of a control step's reactions is summed."""

    node: Array  # (H,) the nodes that boundaries hold, in order; one that several hold has a row for each
    begin: Array  # where the rows of each node begin, and their number: threads divide the nodes, not the rows
    owner: Array  # (H,) the row of each one's boundary among those that are recorded
    arm: Array  # (H, 3) X_n - C [m]
    part: Array  # (H, 3, 3) of the node's impulse that the boundary takes
    place: Array  # (H,) the number of its impulse among those of a state; -1 for a node that never moves
    first: int  # row of a state where the impulses begin
    now: Array  # (H, 3) X_n + u_n - C before a substep [m]
    before: Array  # (H, 3) momentum that a node would have after it without its boundary [kg m/s]
    sums: Array  # (H, 6) impulse and its moment, over the substeps so far
    pushes: tuple[Pushes, ...]  # those of obstacles on soft surfaces, and on the skins of rigid bodies
    span: Array  # (2,) the first substep that the sums have, and the next one that they need
    mean: Array  # (T, B, 6) forces and moments of the boundaries in each control step


class ReactionBars(NamedTuple):
    """Cotangents of reactions, and numbers that wait from one pass of a substep's adjoint to the next."""

    mean: Array  # (T, B, 6)
    impulse: Array  # (H, 3) of the impulses
    after: Array  # (H, 3) m v' [kg m/s]


for _class in (Reactions, ReactionBars):
    own_symbols(_class)


# --- of a model -------------------------------------------------------------------------------------------------------


def make_reactions(
    model: Model, bits: Array, X: Array, obstacles: tuple[Contact, ...], first: int
) -> tuple[Reactions, ...]:
    """Return one entry, or none if no reactions are recorded.

    Args:
        bits: the conditions that apply to each node (M,).
        X: its place at rest (M, D) [m].
        obstacles: contact with obstacles, if there is any.
        first: row of a state where impulses begin.
    """
    names = model.reactions
    if not names:
        return ()
    found = {name: holder for name, holder in holders(model, bits, X).items() if name in names}
    owner = [np.full(len(holder.nodes), names.index(name)) for name, holder in found.items()]
    node = np.concatenate([np.zeros(0, np.int64), *(holder.nodes for holder in found.values())])
    arm = np.concatenate([np.zeros((0, model.dim)), *(holder.arms for holder in found.values())])
    part = np.zeros((len(node), 3, 3))
    part[:, : model.dim, : model.dim] = np.concatenate(
        [np.zeros((0, model.dim, model.dim)), *(holder.parts for holder in found.values())]
    )
    order = np.argsort(node, kind="stable")
    node, owner, arm, part = (
        node[order],
        np.concatenate([np.zeros(0, np.int64), *owner])[order],
        arm[order],
        part[order],
    )
    begin = np.append(np.unique(node, return_index=True)[1], len(node)).astype(np.int64)
    n, skins = len(node), [skin for each in obstacles for rigid in each.rigid for skin in rigid.skin]
    pushes = tuple(p for each in (*obstacles, *skins) for p in each.pushes)
    return (
        Reactions(
            node, begin, owner, in_3d(arm), part, _places(model, bits[node]), first,
            np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, REACTION)), pushes, np.full(2, -1),
            np.zeros((model.n_controls, len(names), REACTION)),
        ),
    )  # fmt: skip


def _places(model: Model, bits: Array) -> Array:
    """Return the number of each node's impulse in a state (H,), for nodes with these bits; -1 if it never moves."""
    clamps = sum(1 << k for k, c in enumerate(model.conditions) if c.spec.name == "sticky")
    carries = sum(1 << k for k, c in enumerate(model.conditions) if getattr(c.spec, "moves", False))
    moves = (bits & clamps == 0) | (bits & carries != 0)
    return np.where(moves, np.cumsum(moves) - 1, -1)


def rows_of_impulses(reactions: tuple[Reactions, ...]) -> int:
    """Return how many rows of a state have impulses: two to a row, as springs."""
    return sum(-(-(int(each.place.max(initial=-1)) + 1) // 2) for each in reactions)


def reactions_by_name(reactions: tuple[Reactions, ...], model: Model) -> dict[str, Array]:
    """Return force [N] and moment [N m] of every recorded boundary (T + 1, D + 1) or (T + 1, 6); zero in row 0."""
    out = {}
    for each in reactions:
        for k, name in enumerate(model.reactions):
            out[name] = np.concatenate([np.zeros((1, len(columns(model.dim)))), each.mean[:, k, columns(model.dim)]])
    return out


def reactions_at(reactions: tuple[Reactions, ...], model: Model, control: int) -> dict[str, Array]:
    """Return the same (D + 1,) or (6,) of the control step that ended at `control`; zero at the start."""
    means = np.zeros((len(model.reactions), REACTION))
    for each in reactions if control > 0 else ():
        means = each.mean[control - 1]
    return {name: means[k, columns(model.dim)] for k, name in enumerate(model.reactions)}


def add_bars_at(pairs: tuple[tuple[Reactions, ReactionBars], ...], model: Model, control: int, bars: Any) -> None:
    """Add the cotangents of `reactions_at`, by name, before the adjoint of that control step runs."""
    for _, back in pairs if control > 0 else ():
        for name, bar in bars.items():
            back.mean[control - 1, model.reactions.index(name), columns(model.dim)] += bar


def columns(dim: int) -> list[int]:
    """Return which of the `REACTION` numbers of a reaction a world of this dimension has."""
    return [0, 1, 5] if dim == 2 else list(range(REACTION))


def zero_bars_of(reactions: Reactions) -> ReactionBars:
    """Return zero cotangents."""
    return ReactionBars(np.zeros_like(reactions.mean), np.zeros_like(reactions.before), np.zeros_like(reactions.before))


# --- a substep --------------------------------------------------------------------------------------------------------


@kernel
def clear_sums(reactions: Reactions, run: NodeRun, step: int, crew: Crew) -> None:
    """Begin the sums of a control step at its first substep; note whether they go on from the last one."""
    begins = step % run.setting.substeps == 0
    if crew.thread == 0:
        if begins:
            reactions.span[0] = step
        elif reactions.span[1] != step:
            reactions.span[0] = -1  # a run that starts again inside a control step knows only a part of it
        reactions.span[1] = step
    if begins:
        lo, hi = share(len(reactions.node), crew.thread, crew.n_threads)
        for h in range(lo, hi):
            reactions.sums[h, :] = 0.0
        clear_pushes_each(reactions.pushes, crew)
    barrier(run.arrivals, crew.n_threads)


@kernel
def clear_pushes(pushes: Pushes, crew: Crew) -> None:
    """Set the sums of points to zero."""
    lo, hi = share(len(pushes.sums), crew.thread, crew.n_threads)
    for s in range(lo, hi):
        pushes.sums[s] = 0.0


@kernel
def note_before(reactions: Reactions, run: NodeRun, at: NodeStep, crew: Crew) -> None:
    """Note the nodes' arms, and the momentum that they would have without their boundaries, before `nodes.kick`."""
    nodes, dt = run.nodes, run.setting.dt
    lo, hi = share(len(reactions.node), crew.thread, crew.n_threads)
    for h in range(lo, hi):
        n = reactions.node[h]
        put(reactions.now, h, arm_of(reactions, h, at.u))
        for d in range(3):
            f = float(run.force[n, d]) + float(run.outside[n, d])
            reactions.before[h, d] = float(nodes.kept[n]) * float(at.v[n, d]) + dt * f
    barrier(run.arrivals, crew.n_threads)


@kernel
def note_impulses(
    reactions: Reactions, run: NodeRun, at: NodeStep, u_next: Array, step: int, keep: bool, crew: Crew
) -> None:
    """Add the impulses of a substep to the sums; with `keep`, write those of nodes that move to the state after it."""
    lo, hi = share(len(reactions.node), crew.thread, crew.n_threads)
    for h in range(lo, hi):
        n, v = reactions.node[h], at.v_next
        after = scale((float(v[n, 0]), float(v[n, 1]), float(v[n, 2])), float(run.nodes.mass[n]))
        J = taken(reactions, h, sub(after, row(reactions.before, h)))
        M = cross(row(reactions.now, h), J)
        for d in range(3):
            reactions.sums[h, d] += J[d]
            reactions.sums[h, 3 + d] += M[d]
        if keep and reactions.place[h] >= 0:
            store_spring(u_next, at.v_next, reactions.first, reactions.place[h], J)
    if crew.thread == 0:
        reactions.span[1] = step + 1


@kernel
def arm_of(reactions: Reactions, h: int, u: Array) -> Any:
    """Return a node's arm for displacements u (M, 4)."""
    n, a = reactions.node[h], reactions.arm
    return a[h, 0] + float(u[n, 0]), a[h, 1] + float(u[n, 1]), a[h, 2] + float(u[n, 2])


@kernel
def taken(reactions: Reactions, h: int, J: Any) -> Any:
    """Return the part of a node's impulse that its boundary takes, W J."""
    W = reactions.part[h]
    return (
        W[0, 0] * J[0] + W[0, 1] * J[1] + W[0, 2] * J[2],
        W[1, 0] * J[0] + W[1, 1] * J[1] + W[1, 2] * J[2],
        W[2, 0] * J[0] + W[2, 1] * J[1] + W[2, 2] * J[2],
    )


@kernel
def taken_vjp(reactions: Reactions, h: int, J_bar: Any) -> Any:
    """Return W^T J_bar."""
    W = reactions.part[h]
    return (
        W[0, 0] * J_bar[0] + W[1, 0] * J_bar[1] + W[2, 0] * J_bar[2],
        W[0, 1] * J_bar[0] + W[1, 1] * J_bar[1] + W[2, 1] * J_bar[2],
        W[0, 2] * J_bar[0] + W[1, 2] * J_bar[1] + W[2, 2] * J_bar[2],
    )


@kernel
def add_up(reactions: Reactions, run: NodeRun, step: int, crew: Crew) -> None:
    """Write the means of a control step after its last substep, on one thread, if the sums have all its substeps."""
    barrier(run.arrivals, crew.n_threads)
    control, substeps = step // run.setting.substeps, run.setting.substeps
    if crew.thread == 0 and reactions.span[0] == control * substeps:
        mean, per = reactions.mean[control], 1.0 / (substeps * run.setting.dt)
        mean[:] = 0.0
        for h in range(len(reactions.node)):
            for d in range(mean.shape[1]):
                mean[reactions.owner[h], d] += reactions.sums[h, d] * per
        add_pushes_each(reactions.pushes, mean)


@kernel
def add_pushes(pushes: Pushes, mean: Array) -> None:
    """Add what obstacles have done to points."""
    for o in range(len(pushes.owner)):
        if pushes.owner[o] >= 0:
            for s in range(len(pushes.sums)):
                for d in range(mean.shape[1]):
                    mean[pushes.owner[o], d] += pushes.sums[s, o, d] * pushes.per


clear_pushes_each, add_pushes_each = for_each(clear_pushes), for_each(add_pushes)
clear_sums_each, note_before_each = for_each(clear_sums), for_each(note_before)
note_impulses_each, add_up_each = for_each(note_impulses), for_each(add_up)


# --- its adjoint ------------------------------------------------------------------------------------------------------


@kernel
def impulses_vjp(
    pair: tuple[Reactions, ReactionBars], run: NodeRun, bars: NodeBars, at: NodeStep, u_next: Array, reversed_: bool,
    crew: Crew,
) -> None:  # fmt: skip
    """Add the adjoint of m v' to the cotangents of masses and of velocities after a substep, before other passes."""
    (reactions, back), dt = pair, run.setting.dt
    per = 1.0 / (run.setting.substeps * dt)
    lo, hi = share(len(reactions.begin) - 1, crew.thread, crew.n_threads)
    for h in range(reactions.begin[lo], reactions.begin[hi]):
        n, total, m = reactions.node[h], 0.0, float(run.nodes.mass[reactions.node[h]])
        a = arm_of(reactions, h, at.u)
        if reversed_:  # at.u is not known yet
            v, b = at.v_next, arm_of(reactions, h, u_next)
            a = b[0] - dt * float(v[n, 0]), b[1] - dt * float(v[n, 1]), b[2] - dt * float(v[n, 2])
        R = back.mean[at.control, reactions.owner[h]]
        J_bar = taken_vjp(reactions, h, scale(add((R[0], R[1], R[2]), cross((R[3], R[4], R[5]), a)), per))
        put(back.impulse, h, J_bar)
        for d in range(3):
            v = float(at.v_next[n, d])
            back.after[h, d] = m * v
            bars.v[n, d] += m * J_bar[d]
            total += v * J_bar[d]
        bars.mass[n] += total
    barrier(run.arrivals, crew.n_threads)


@kernel
def forces_vjp(pair: tuple[Reactions, ReactionBars], run: NodeRun, bars: NodeBars, crew: Crew) -> None:
    """Add the adjoint of the nodes' forces to what `nodes.begin_vjp` has found."""
    (reactions, back), dt = pair, run.setting.dt
    lo, hi = share(len(reactions.begin) - 1, crew.thread, crew.n_threads)
    for h in range(reactions.begin[lo], reactions.begin[hi]):
        n = reactions.node[h]
        for d in range(3):
            bars.pairs[2 * n + 1, d] -= dt * back.impulse[h, d]
            bars.outside[n, d] -= dt * back.impulse[h, d]
    barrier(run.arrivals, crew.n_threads)


@kernel
def before_vjp(
    pair: tuple[Reactions, ReactionBars], run: NodeRun, bars: NodeBars, at: NodeStep, u_next: Array, reversed_: bool,
    crew: Crew,
) -> None:  # fmt: skip
    """Add the rest of the adjoint to the cotangents of the state before a substep, after all other passes."""
    (reactions, back), dt = pair, run.setting.dt
    per = 1.0 / (run.setting.substeps * dt)
    lo, hi = share(len(reactions.begin) - 1, crew.thread, crew.n_threads)
    for h in range(reactions.begin[lo], reactions.begin[hi]):
        n, total, kept = reactions.node[h], 0.0, float(run.nodes.kept[reactions.node[h]])
        for d in range(3):
            v = float(at.v[n, d])
            bars.v[n, d] -= kept * back.impulse[h, d]
            total += v * back.impulse[h, d]
            if reversed_:
                f = float(bars.sums[2 * n + 1, d]) + float(run.outside[n, d])
                back.after[h, d] -= kept * v + dt * f
        bars.kept[n] -= total
        if reactions.place[h] >= 0:
            R = back.mean[at.control, reactions.owner[h]]
            J = taken(reactions, h, row(back.after, h))
            if not reversed_:
                J = load_spring(u_next, at.v_next, reactions.first, reactions.place[h])
            u_bar = scale(cross(J, (R[3], R[4], R[5])), per)
            for d in range(3):
                bars.u[n, d] += u_bar[d]
    barrier(run.arrivals, crew.n_threads)


impulses_each_vjp, forces_each_vjp, before_each_vjp = for_each(impulses_vjp), for_each(forces_vjp), for_each(before_vjp)
