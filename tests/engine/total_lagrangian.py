"""The reference frame's substep in plain NumPy: slow, complex, and sharing no code with the engine.

Weights and arms d = X_n - X_p are those of the rest positions, and every body has nodes of its own:

    F_p = I + A sum_n w u_n d^T,  f_n = -sum_p w A vol0 P d + sum_p w f_p,  v' = kept v / m + dt f / m,  u' = u + dt v'

with A = 4 / dx^2. Stresses, forces and histories are those of `reference.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import reference
from gripping import Gripping
from mean_volumes import more_stress
from reference import Array, Moving, t
from split_nodes import layers
from touching import Meeting, Touching

from cqrun.engine.model import Inputs, Model, Records
from cqrun.engine.policy import Policy
from cqrun.engine.setting import node_positions
from cqrun.engine.statics.holding import Planes


def stencil(model: Model, X: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Yield (node, weight, arm) of every particle; nodes of a body, and of each side of a gap, have own numbers."""
    n_grid, n_bodies = int(np.prod(model.grid_shape)), len(model.layout.counts)
    body = np.repeat(np.arange(n_bodies), model.layout.counts)
    for (node, weight, arm), layer in zip(reference.stencil(model, X), layers(model, X).values(), strict=True):
        yield node + n_grid * (body + n_bodies * layer), weight, arm


def count_nodes(model: Model, stencils: list[tuple[Array, Array, Array]]) -> int:
    """Return the number of nodes of all bodies in all layers."""
    all_bodies = len(model.layout.counts) * int(np.prod(model.grid_shape))
    return (max(int(node.max()) for node, _, _ in stencils) // all_bodies + 1) * all_bodies


def held(model: Model, v: Array, present: Array) -> Array:
    """Return the nodes' velocities after the boundaries."""
    n_grid = int(np.prod(model.grid_shape))
    for condition in model.conditions:
        for n in np.flatnonzero(condition.nodes[np.arange(len(v)) % n_grid] & present):
            v[n], _ = reference.after(condition.spec.name, np.array(condition.normal), 0.0, v[n])
    return v


def gathered(stencils: list[tuple[Array, Array, Array]], g: Array) -> tuple[Array, Array]:
    """Return sum_n w g_n and sum_n w g_n d^T of every particle."""
    value = sum(weight[:, None] * g[node] for node, weight, _ in stencils)
    return value, sum(weight[:, None, None] * g[node][:, :, None] * arm[:, None, :] for node, weight, arm in stencils)


def scattered(stencils: list[tuple[Array, Array, Array]], n_nodes: int, p: Array, G: Array | None = None) -> Array:
    """Return sum_p w (p + G d) of every node."""
    weights = (weight for _, weight, _ in stencils)
    out = np.zeros((n_nodes, *p.shape[1:]), np.result_type(p, float if G is None else G, *weights))
    for node, weight, arm in stencils:
        field = p if G is None else p + np.einsum("pij,pj->pi", G, arm)
        np.add.at(out, node, (weight * field.T).T)
    return out


def motion(
    model: Model, X: Array, stencils: list[tuple[Array, Array, Array]], u: Array, v: Array, history: dict[str, Array]
) -> Moving:
    """Return what particles do if nodes have these displacements and velocities."""
    A = 4 / model.dx**2
    moved, gradient = gathered(stencils, u)
    speed, rate = gathered(stencils, v)
    F = np.eye(model.dim) + A * gradient
    return Moving(X + moved, speed, A * rate @ np.linalg.inv(F), F, history)


def ghost_runs(
    model: Model, stencils: list[tuple[Array, Array, Array]], volume: Array
) -> list[tuple[list[int], Array]]:
    """Return the runs of four nodes along an axis of which one is nearly empty, with their least fill."""
    n_grid = int(np.prod(model.grid_shape))
    fill = scattered(stencils, count_nodes(model, stencils), volume) / model.dx**model.dim
    found: list[tuple[list[int], Array]] = []
    if split(model, stencils):
        for axis in range(model.dim):
            for run in joined_runs(model, stencils, axis):
                lightest = run[int(np.argmin(fill[run].real))]
                if 0 < fill[lightest].real < 0.6:
                    found.append((run, fill[lightest]))
        return found
    for n in np.flatnonzero(fill.real > 0):
        place = np.array(np.unravel_index(n % n_grid, model.grid_shape))
        for axis in range(model.dim):
            steps = place + np.outer(np.arange(4), np.eye(model.dim, dtype=int)[axis])
            if steps[-1][axis] < model.grid_shape[axis]:
                run = [n - n % n_grid + int(np.ravel_multi_index(step, model.grid_shape)) for step in steps]
                lightest = run[int(np.argmin(fill[run].real))]
                if 0 < fill[lightest].real < 0.6:
                    found.append((run, fill[lightest]))
    return found


def split(model: Model, stencils: list[tuple[Array, Array, Array]]) -> bool:
    """Return whether any node is split."""
    return count_nodes(model, stencils) > len(model.layout.counts) * int(np.prod(model.grid_shape))


def joined_runs(model: Model, stencils: list[tuple[Array, Array, Array]], axis: int) -> list[list[int]]:
    """Return the runs of four nodes along an axis, each of which shares a particle with the next."""
    following: dict[int, set[int]] = {}
    offsets = list(np.ndindex(*(3,) * model.dim))
    for k, offset in enumerate(offsets):
        if offset[axis] < 2:
            other = offsets.index(tuple(o + (a == axis) for a, o in enumerate(offset)))
            for here, there in zip(stencils[k][0], stencils[other][0], strict=True):
                following.setdefault(int(here), set()).add(int(there))
    runs = [[n] for n in following]
    for _ in range(3):
        runs = [[*run, there] for run in runs for there in sorted(following.get(run[-1], ()))]
    return runs


def ghost_force(model: Model, runs: list[tuple[list[int], Array]], mu: Array, u: Array) -> Array:
    """Return -dE/du of E = 1e-3 mu dx^(D-2) / 2 sum fill |u_3 - 3 u_2 + 3 u_1 - u_0|^2."""
    n_grid, third = int(np.prod(model.grid_shape)), (-1, 3, -3, 1)
    f = np.zeros(u.shape, np.result_type(u, mu, *(fill for _, fill in runs)))
    for run, fill in runs:
        difference = np.dot(third, u[run])
        for node, factor in zip(run, third, strict=True):
            f[node] -= 1e-3 * mu[node // n_grid % len(mu)] * model.dx ** (model.dim - 2) * fill * factor * difference
    return f


def mean_shear_modulus(model: Model, inputs: Inputs) -> Array:
    """Return the mean of mu of the two elastic laws over the volume of each body."""
    mu, V = sum(E / (2 * (1 + nu)) for E, nu in inputs.terms[0][:2]), inputs.fields.volume
    return np.array([(mu[part] * V[part]).sum() / V[part].sum() for part in model.layout.slices()])


class Acting:
    """The mean force and moment of each recorded boundary in each control step.

    Boundaries divide the impulse of a node as at rest. The arm is from the mean of all nodes of a boundary. An
    obstacle's moment is about the world's origin.
    """

    def __init__(self, model: Model, present: Array) -> None:
        self.model, n_grid = model, int(np.prod(model.grid_shape))
        self.X = node_positions(model.grid_shape, model.dx)[np.arange(len(present)) % n_grid]
        bits = sum(
            (condition.nodes[np.arange(len(present)) % n_grid] & present).astype(int) << k
            for k, condition in enumerate(model.conditions)
        )
        planes = Planes(model.conditions, model.size, bits, self.X)
        self.nodes = {name: np.flatnonzero(planes.of(name)) for name in model.reactions}
        self.parts = {
            name: np.array([each.parts[name] for each in planes.shares(nodes)]) for name, nodes in self.nodes.items()
        }
        self.rows: dict[str, list[Array]] = {name: [np.zeros(self.size)] for name in model.reactions}
        self.sums: dict[str, Array] = {}

    @property
    def size(self) -> int:
        return 3 if self.model.dim == 2 else 6

    def add(self, name: str, force: Array, moment: Array) -> None:
        zero = np.zeros(self.size, complex)
        self.sums[name] = self.sums.get(name, zero) + np.concatenate([force, np.atleast_1d(moment)])

    def hold(self, u: Array, impulse: Array) -> None:
        for name, nodes in self.nodes.items():
            if len(nodes):
                arms = self.X[nodes] + u[nodes] - self.X[nodes].mean(axis=0)
                taken = np.einsum("nij,nj->ni", self.parts[name], impulse[nodes])
                self.add(name, taken.sum(axis=0), turning(arms, taken).sum(axis=0))

    def push(self, touching: Touching) -> None:
        for o, x, force in touching.pushed:
            name = name_of(self.model, o)
            if name in self.rows:
                self.add(name, self.model.dt * force, self.model.dt * turning(x[None], force[None])[0])

    def end(self) -> None:
        """Turn the sums of a control step into means."""
        zero = np.zeros(self.size)
        for name, rows in self.rows.items():
            rows.append(self.sums.get(name, zero) / (self.model.substeps * self.model.dt))
        self.sums = {}

    def by_name(self) -> dict[str, Array]:
        return {name: np.array(rows) for name, rows in self.rows.items()}


def name_of(model: Model, o: int) -> str:
    """Return the name of an obstacle: of its boundary, or of the rigid body."""
    first = len(model.obstacles)
    return model.rigid[o - first].name if o >= first else model.conditions[model.obstacles[o].condition].name


def turning(a: Array, f: Array) -> Array:
    """Return a x f: (n,) in 2D, (n, 3) in 3D."""
    return a[:, 0] * f[:, 1] - a[:, 1] * f[:, 0] if a.shape[1] == 2 else np.cross(a, f)


def rollout(
    model: Model, inputs: Inputs, watch: Callable[..., None] = lambda *contact: None, policy: Policy | None = None
) -> tuple[Records, Moving]:
    """Return the probe's records and the last state; `watch` gets what touches obstacles, and what meets.

    A policy, if there is one, writes the activations of the inputs as it decides them, and what it last remembers.
    """
    X, fields, dt, A = inputs.state.x, inputs.fields, model.dt, 4 / model.dx**2
    stencils = list(stencil(model, X))
    n_nodes = count_nodes(model, stencils)
    m, kept = (scattered(stencils, n_nodes, a * fields.mass) for a in (1.0, np.exp(-fields.damping * dt)))
    present = m.real > 0
    v = scattered(stencils, n_nodes, fields.mass[:, None] * inputs.state.v, fields.mass[:, None, None] * inputs.state.C)
    v[present] /= m[present, None]
    v, u = held(model, v, present), np.zeros_like(v)
    touching = None
    if model.surface is not None:
        touching = (Gripping if model.rigid else Touching)(model, inputs, stencils)
    meeting = None
    if model.meeting is not None:
        body = np.repeat(np.arange(len(model.layout.counts)), model.layout.counts)[model.surface.particle]
        meeting = Meeting(model, inputs.coefficients[len(model.conditions)], touching, body)
    watch(touching, meeting)
    acting = Acting(model, present)
    runs, mu = ghost_runs(model, stencils, fields.volume), mean_shear_modulus(model, inputs)
    W, rows = model.probe.toarray(), []
    s, memory = motion(model, X, stencils, u, v, inputs.state.history), inputs.state.memory
    for step in range(model.n_steps):
        if step % model.substeps == 0:
            rows.append(reference.seen(W, s))
            see_bodies(touching)
            if policy is not None:
                k = step // model.substeps
                poses = {name: seen[-1] for name, seen in touching.rows.items()}
                held_ = {name: seen[-1] for name, seen in acting.rows.items()}
                seen = reference.sight(model, inputs, rows[-1], k, rigid=poses, held=held_)
                inputs.activation[k], memory = policy.act(k, seen, memory, lambda: None)
        pushed, _ = reference.active_force(model, inputs, s, step)
        tau = reference.kirchhoff(model, inputs, s, step)
        if model.averaged:
            tau = tau + more_stress(model, inputs, X, s.F)
        P = tau @ t(np.linalg.inv(s.F))
        f = scattered(stencils, n_nodes, fields.force + pushed, -A * fields.volume[:, None, None] * P)
        if touching is not None:
            f = f + touching.forces(u, v)
            acting.push(touching)
        if meeting is not None:
            f = f + meeting.forces(u, v)
        f = f + ghost_force(model, runs, mu, u)
        after = np.zeros_like(f)
        before = kept[:, None] * v + dt * f
        after[present] = before[present] / m[present, None]
        v = held(model, after, present)
        acting.hold(u, m[:, None] * v - before)
        if (step + 1) % model.substeps == 0:
            acting.end()
        u = u + dt * v
        s = motion(model, X, stencils, u, v, reference.relaxed(inputs, s.history, s.F, dt))
    rows.append(reference.seen(W, s))
    see_bodies(touching)
    inputs.state.memory = memory
    poses = touching.poses() if isinstance(touching, Gripping) else {}
    return replace(reference.recorded(rows), held=acting.by_name(), rigid=poses), s


def see_bodies(touching: Touching | None) -> None:
    """Note the poses of rigid bodies."""
    if isinstance(touching, Gripping):
        touching.see()
