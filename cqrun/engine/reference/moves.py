"""Boundaries that move: their nodes follow a displacement and a rotation, as a function of time.

    u_n(t) = a d + (R(a theta) - I) (X_n - c),    a = min(t / over, 1),    v' = (u_n(t + dt) - u_n(t)) / dt

Only `sticky` boundaries move, so all directions of a node are given. The table of poses has, for each plane and
substep, a d and R(a theta) - I; its cotangent is summed over nodes, and goes to d and theta at the end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cqrun.engine.model import Model
from cqrun.engine.reference.setting import NodeBars, NodeRun
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import barrier, for_each, kernel, own_symbols, share
from cqrun.plugin.contract import Array

STEP = 1e-30
"""Of complex steps."""

SMALL = 1e-6
"""Square of an angle below which its functions are series."""


class Moves(NamedTuple):
    """The nodes of boundaries that move."""

    nodes: Array  # (H,)
    plane: Array  # (H,) the row of each node's boundary in the table
    arm: Array  # (H, D) X_n - c [m]
    pose: Array  # (P, T + 1, D + D^2) a d and R - I after each substep


own_symbols(Moves)


def rotation_matrix(theta: Array) -> Array:
    """Return R - I (..., D, D) of angles (..., 1) or rotation vectors (..., 3) [rad]; theta may be complex.

    3D: I + s W + c W^2 with W = [theta]x, s = sin(phi) / phi and c = (1 - cos(phi)) / phi^2 (Rodrigues).
    """
    square = (theta * theta).sum(axis=-1)
    phi = np.sqrt(np.where(np.abs(square) < SMALL, 1.0, square))
    small = np.abs(square) < SMALL
    s = np.where(small, 1.0 - square / 6.0 + square**2 / 120.0, np.sin(phi) / phi)
    c = np.where(small, 0.5 - square / 24.0 + square**2 / 720.0, (1.0 - np.cos(phi)) / phi**2)
    W = np.zeros((*square.shape, 3, 3), theta.dtype)
    x, y, z = (0.0 * square, 0.0 * square, theta[..., 0]) if theta.shape[-1] == 1 else np.moveaxis(theta, -1, 0)
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -z, y, -x
    W[..., 1, 0], W[..., 2, 0], W[..., 2, 1] = z, -y, x
    R = s[..., None, None] * W + c[..., None, None] * W @ W
    return R[..., :2, :2] if theta.shape[-1] == 1 else R


def parts_of(model: Model) -> list[tuple[int, float | None]]:
    """Return the planes that move, and the time in which each reaches its place [s]; None for the whole run."""
    return [(k, c.spec.over) for k, c in enumerate(model.conditions) if getattr(c.spec, "moves", False)]


def progress(model: Model, over: float | None) -> Array:
    """Return a after each substep (T + 1,)."""
    end = over if over is not None else model.n_steps * model.dt
    return np.minimum(np.arange(model.n_steps + 1) * model.dt / end, 1.0)


def poses(model: Model, moves: Array, shares: list[Array]) -> Array:
    """Return the table (P, S, D + D^2) for `Inputs.moves` and the shares a (S,) of each moving plane."""
    dim, rows = model.dim, []
    for (k, _), a in zip(parts_of(model), shares, strict=True):
        d, theta = a[:, None] * moves[k, :dim], a[:, None] * moves[k, dim:]
        rows.append(np.concatenate([d, rotation_matrix(theta).reshape(len(a), -1)], axis=1))
    return np.array(rows)


def poses_vjp(model: Model, moves: Array, shares: list[Array], pose_bar: Array) -> Array:
    """Return the cotangent of `Inputs.moves`; the slopes of R by a complex step."""
    dim, out = model.dim, np.zeros(moves.shape)
    for row, ((k, _), a) in enumerate(zip(parts_of(model), shares, strict=True)):
        out[k, :dim] = a @ pose_bar[row, :, :dim]
        for axis in range(dim, moves.shape[1]):
            theta = a[:, None] * moves[k, dim:].astype(complex)
            theta[:, axis - dim] += 1j * STEP * a
            slope = np.imag(rotation_matrix(theta)).reshape(len(a), -1) / STEP
            out[k, axis] = (pose_bar[row, :, dim:] * slope).sum()
    return out


def moving_nodes(model: Model, bits: Array, X: Array) -> tuple[Array, Array, Array]:
    """Return the nodes that move (H,), the row of each one's plane, and their arms (H, D), for nodes at X (M, D)."""
    nodes, planes, arms = [], [], []
    free = np.ones(len(bits), bool)
    for row, (k, _) in enumerate(parts_of(model)):
        own = np.flatnonzero(free & ((bits >> k) & 1 == 1))
        free[own] = False  # a node in several boundaries that move follows the first
        c = model.center(model.conditions[k].name, X[own]) if len(own) else np.zeros(model.dim)
        nodes.append(own)
        planes.append(np.full(len(own), row))
        arms.append(X[own] - c)
    return np.concatenate(nodes), np.concatenate(planes), np.concatenate(arms)


@kernel
def target(moves: Moves, h: int, step: int, d: int) -> float:
    """Return component d of the displacement of moving node h after a number of substeps."""
    dim, plane = moves.arm.shape[1], moves.plane[h]
    total = moves.pose[plane, step, d]
    for k in range(dim):
        total += moves.pose[plane, step, dim + d * dim + k] * moves.arm[h, k]
    return total


@kernel
def carry(moves: Moves, run: NodeRun, u: Array, u_next: Array, v_next: Array, step: int, crew: Crew) -> None:
    """Set the motion of moving nodes at the end of a substep."""
    lo, hi = share(len(moves.nodes), crew.thread, crew.n_threads)
    for h in range(lo, hi):
        n = moves.nodes[h]
        for d in range(moves.arm.shape[1]):
            there = target(moves, h, step + 1, d)
            v_next[n, d] = (there - u[n, d]) / run.setting.dt
            u_next[n, d] = there
    barrier(run.arrivals, crew.n_threads)


@kernel
def carry_vjp(moves: Moves, pose_bar: Array, run: NodeRun, bars: NodeBars, step: int, crew: Crew) -> None:
    """Run the adjoint of `carry`, on one thread; `nodes.begin_vjp` then finds v_bar + dt u_bar = 0 at these nodes."""
    if crew.thread == 0:
        dim, dt = moves.arm.shape[1], run.setting.dt
        for h in range(len(moves.nodes)):
            n, plane = moves.nodes[h], moves.plane[h]
            for d in range(dim):
                there_bar = bars.u[n, d] + bars.v[n, d] / dt
                pose_bar[plane, step + 1, d] += there_bar
                for k in range(dim):
                    pose_bar[plane, step + 1, dim + d * dim + k] += there_bar * moves.arm[h, k]
                bars.u[n, d] = -bars.v[n, d] / dt
    barrier(run.arrivals, crew.n_threads)


@kernel
def bring_back(moves: Moves, run: NodeRun, v: Array, step: int, crew: Crew) -> None:
    """Set the velocity of moving nodes before a substep, in a run that is reversed."""
    if step > 0:
        lo, hi = share(len(moves.nodes), crew.thread, crew.n_threads)
        for h in range(lo, hi):
            for d in range(moves.arm.shape[1]):
                change = target(moves, h, step, d) - target(moves, h, step - 1, d)
                v[moves.nodes[h], d] = change / run.setting.dt
    barrier(run.arrivals, crew.n_threads)


@kernel
def carry_pair_vjp(pair: tuple[Moves, Array], run: NodeRun, bars: NodeBars, step: int, crew: Crew) -> None:
    """Run `carry_vjp` for moving nodes and the cotangent of their poses."""
    carry_vjp(pair[0], pair[1], run, bars, step, crew)


@kernel
def bring_back_pair(pair: tuple[Moves, Array], run: NodeRun, v: Array, step: int, crew: Crew) -> None:
    """Run `bring_back` for moving nodes that come with the cotangent of their poses."""
    bring_back(pair[0], run, v, step, crew)


carry_each = for_each(carry)
carry_each_vjp = for_each(carry_pair_vjp)
bring_back_pairs = for_each(bring_back_pair)
