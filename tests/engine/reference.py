"""The substep written from the papers' equations in plain NumPy: slow, complex, and sharing no code with the engine.

MLS-MPM with APIC and quadratic B-splines (CQ1 eqs 3-10), a material that is the sum of fixed corotated and
Neo-Hookean elasticity (CQ2 eqs 12, 13), Kelvin-Voigt viscosity, the penalty of CQ2 eq 14, muscles and pressures,
cables (CQ2 eqs 16, 17) and body forces, the boundaries of CQ1's supplement XI. Every input may carry an imaginary
part of 1e-30, whose image in the output is an exact derivative (complex step): branches look at real parts alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cqrun.actuators import body_force, cable, muscle, pressure, tension
from cqrun.engine.model import ActuatorModel, Inputs, Model, Records
from cqrun.engine.policy import Policy, Sight
from cqrun.engine.setting import MARGIN
from cqrun.state import State

EPSILON = 1e-7  # of the friction law, both papers

Array = np.ndarray


@dataclass
class Moving:
    """Position, velocity, affine matrix, deformation gradient; real or complex."""

    x: Array
    v: Array
    C: Array
    F: Array
    history: dict[str, Array] = field(default_factory=dict)


def t(A: Array) -> Array:
    """Return the transpose of each matrix."""
    return np.swapaxes(A, -1, -2)


def rotation(F: Array) -> Array:
    """Return R of F = R S for det F > 0, by Newton's iteration with inverses.

    An imaginary part of 1e-30 converges one step behind the real one: two more steps.
    """
    R, to_go = F, 100
    while to_go:
        following = 0.5 * (R + t(np.linalg.inv(R)))
        if np.abs(following - R).max() < 1e-12:
            to_go = min(to_go, 3)
        R, to_go = following, to_go - 1
    return R


def determinant(F: Array) -> Array:
    """Return det F by Leibniz' formula, (N,)."""
    dim = F.shape[-1]
    total = 0.0
    for p in itertools.permutations(range(dim)):
        sign = (-1) ** sum(p[i] > p[j] for i in range(dim) for j in range(i + 1, dim))
        term = sign
        for i in range(dim):
            term = term * F[:, i, p[i]]
        total = total + term
    return total


def first_piola(E: Array, nu: Array, F: Array, law: str) -> Array:
    """Return P of the elastic laws, CQ2 eqs 12 and 13."""
    mu, lam = (a[:, None, None] for a in (E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))))
    J, F_inv_t = determinant(F)[:, None, None], t(np.linalg.inv(F))
    if law == "fixed_corotated":
        return 2 * mu * (F - rotation(F)) + lam * (J - 1) * J * F_inv_t
    return mu * (F - F_inv_t) + lam * np.log(J) * F_inv_t


def matrix(rows: Array) -> Array:
    """Return the symmetric matrix with these entries, the diagonal first."""
    dim = 2 if len(rows) == 3 else 3
    S = np.diag(rows[:dim])
    for (i, j), value in zip(itertools.combinations(range(dim), 2), rows[dim:], strict=True):
        S[i, j] = S[j, i] = value
    return S


def driven(model: Model, inputs: Inputs, kind: type, step: int) -> Iterator[tuple[ActuatorModel, Any, Any]]:
    """Yield (actuator, activation, strength) of every actuator of one kind."""
    for a, actuator in enumerate(model.actuators):
        if actuator.kernel is kind:
            yield actuator, inputs.activation[step // model.substeps, a], inputs.strength[a]


def weights(model: Model, inputs: Inputs, actuator: ActuatorModel) -> Any:
    """Return the weights of an actuator's particles, 1 where there are none."""
    a = next(k for k, other in enumerate(model.actuators) if other is actuator)
    return inputs.weights[model.weight_slices[a]] if len(inputs.weights) else np.ones(len(actuator.particles))


def active_stress(model: Model, inputs: Inputs, step: int) -> tuple[Array, Array]:
    """Return the second Piola-Kirchhoff stress of the muscles (N, D, D), and the pressures (N, 1, 1)."""
    n, dim = inputs.state.x.shape
    kind = np.result_type(inputs.activation, inputs.strength, inputs.weights)
    S, p = np.zeros((n, dim, dim), kind), np.zeros((n, 1, 1), kind)
    for actuator, u, strength in driven(model, inputs, muscle.MuscleKernel, step):
        share = weights(model, inputs, actuator)[:, None, None]
        S[actuator.particles] += u * strength * share * matrix(actuator.constants)
    for actuator, u, strength in driven(model, inputs, pressure.PressureKernel, step):
        p[actuator.particles] += u * strength * weights(model, inputs, actuator)[:, None, None] * actuator.constants
    return S, p


def active_force(model: Model, inputs: Inputs, s: Moving, step: int) -> tuple[Array, list[tuple[Any, ...]]]:
    """Return the forces of cables, springs and body forces (N, D), and which cables pull.

    The energy of a cable is E = k/2 max(0, L - max(0, u) R)^2, or max(0, u) T L with a given tension, and f = -dE/dx.
    """
    f = np.zeros(s.x.shape, np.result_type(s.x, inputs.activation, inputs.strength, inputs.rest, inputs.fields.mass))
    taut = []
    for actuator, u, k in driven(model, inputs, cable.CableKernel, step):
        route = s.x[actuator.particles]
        gaps = route[1:] - route[:-1]
        lengths = np.sqrt((gaps * gaps).sum(axis=1))
        rest = inputs.rest[next(a for a, other in enumerate(model.actuators) if other is actuator)]
        stretch = lengths.sum() - (u if u.real > 0 else 0.0) * rest
        taut.append(("cable", actuator.name, stretch.real > 0, u.real > 0))
        if stretch.real > 0:
            pull = k * stretch * gaps / lengths[:, None]
            np.add.at(f, actuator.particles[:-1], pull)
            np.add.at(f, actuator.particles[1:], -pull)
    for actuator, u, strength in driven(model, inputs, tension.TensionKernel, step):
        taut.append(("tension", actuator.name, u.real > 0))
        if u.real > 0:
            gaps = np.diff(s.x[actuator.particles], axis=0)
            pull = u * strength * gaps / np.sqrt((gaps * gaps).sum(axis=1))[:, None]
            np.add.at(f, actuator.particles[:-1], pull)
            np.add.at(f, actuator.particles[1:], -pull)
    for k, part in enumerate(model.forces, start=len(model.actuators)):
        if len(part.particles):
            gaps = np.diff(s.x[part.particles], axis=0)
            lengths = np.sqrt((gaps * gaps).sum(axis=1))
            pull = inputs.strength[k] * (lengths.sum() - inputs.rest[k]) * gaps / lengths[:, None]
            np.add.at(f, part.particles[:-1], pull)
            np.add.at(f, part.particles[1:], -pull)
    for actuator, u, acceleration in driven(model, inputs, body_force.BodyForceKernel, step):
        own = actuator.particles
        f[own] += u * acceleration * inputs.fields.mass[own, None] * actuator.constants
    return f, taut


def kirchhoff(model: Model, inputs: Inputs, s: Moving, step: int) -> Array:
    """Return tau of every particle, (N, D, D) [Pa]."""
    (fixed, neo, viscous, penalty, *more), F, eye = inputs.terms[0], s.F, np.eye(model.dim)
    J, F_inv_t = determinant(F)[:, None, None], t(np.linalg.inv(F))
    P = first_piola(*fixed, F, "fixed_corotated") + first_piola(*neo, F, "neo_hookean")
    E, nu = (a[:, None, None] for a in penalty)
    P = P + E / (3 * (2 - 4 * nu)) * 2 * (J - 1) * J * F_inv_t
    S, p = active_stress(model, inputs, step)
    P = P + F @ S
    eta, zeta = (a[:, None, None] for a in viscous)
    d = (s.C + t(s.C)) / 2
    tr = np.trace(d, axis1=1, axis2=2)[:, None, None]
    for (modulus, _), relaxed_to in zip(more, s.history.values(), strict=True):
        P = P + (modulus * (strain(F) - relaxed_to))[:, None, None] * F
    return P @ t(F) - p * J * eye + J * (2 * eta * (d - tr / 3 * eye) + zeta * tr * eye)


def strain(F: Array) -> Array:
    """Return what the relaxing stress follows, |F|^2 / 2 (N,)."""
    return 0.5 * (F * F).sum(axis=(1, 2))


def spline(r: Array) -> Array:
    """Return the quadratic B-spline at distances r, in cells."""
    a = np.abs(r.real)
    inner, outer = 0.75 - r * r, 0.5 * (1.5 - r * np.sign(r.real)) ** 2
    return np.where(a < 0.5, inner, np.where(a < 1.5, outer, 0.0))


def stencil(model: Model, x: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Yield (node, weight, arm x_i - x_p) of every particle, one node of the 3^D at a time."""
    base = np.floor(x.real / model.dx - 0.5).astype(int)
    for offset in itertools.product(range(3), repeat=model.dim):
        place = base + offset
        weight = np.prod(spline(place - x / model.dx), axis=1)
        node = np.ravel_multi_index(tuple((place + MARGIN).T), model.grid_shape)
        yield node, weight, place * model.dx - x


def to_grid(model: Model, inputs: Inputs, s: Moving, step: int, pushed: Array | float = 0.0) -> tuple[Array, Array]:
    """Return (momentum, mass) of the nodes: CQ1 eqs 3-5, with damping, external forces and those of actuators."""
    dt, fields = model.dt, inputs.fields
    kept = np.exp(-fields.damping * dt) * fields.mass
    tau = kirchhoff(model, inputs, s, step)
    G = kept[:, None, None] * s.C - (4 / model.dx**2) * dt * fields.volume[:, None, None] * tau
    p = kept[:, None] * s.v + dt * (fields.force + pushed)
    kind = np.result_type(G, p, s.x)
    n_nodes = int(np.prod(model.grid_shape))
    mv, m = np.zeros((n_nodes, model.dim), kind), np.zeros(n_nodes, kind)
    for node, weight, arm in stencil(model, s.x):
        np.add.at(m, node, weight * fields.mass)
        np.add.at(mv, node, weight[:, None] * (p + np.einsum("pij,pj->pi", G, arm)))
    return mv, m


def grid_velocity(model: Model, inputs: Inputs, mv: Array, m: Array) -> tuple[Array, list[tuple[Any, ...]]]:
    """Return node velocities after the boundaries, and the branch that each held node took."""
    present = m.real > 0
    v = np.zeros_like(mv)
    v[present] = mv[present] / m[present, None]
    branches = []
    for k, condition in enumerate(model.conditions):
        n = np.array(condition.normal)
        for i in np.flatnonzero(condition.nodes & present):
            v[i], branch = after(condition.spec.name, n, inputs.coefficients[k], v[i])
            branches.append((condition.spec.name, k, int(i), branch))
    return v, branches


def after(kind: str, n: Array, c: float, v: Array) -> tuple[Array, int]:
    """Return a node's velocity after one boundary, and which branch it took."""
    normal = v @ n
    tangent = v - normal * n
    leaves = int(normal.real >= 0)
    if kind == "sticky":
        return 0 * v, 0
    if kind == "slip":
        return tangent, 0
    if kind == "separate":
        return (v if leaves else tangent), leaves
    speed = np.sqrt(tangent @ tangent + EPSILON)
    left = speed + c * (0 if leaves else normal)
    if left.real < 0:
        return 0 * v + (normal * n if leaves else 0), 2
    return tangent * left / speed + (normal * n if leaves else 0), leaves


def substep(model: Model, inputs: Inputs, s: Moving, step: int) -> tuple[Moving, list[tuple[Any, ...]]]:
    """Return the state after one substep (CQ1 eqs 8-10), and the branches taken by cables and on the grid."""
    dt = model.dt
    pushed, taut = active_force(model, inputs, s, step)
    v_grid, branches = grid_velocity(model, inputs, *to_grid(model, inputs, s, step, pushed))
    kind = np.result_type(v_grid, s.x)
    v, B = np.zeros(s.v.shape, kind), np.zeros(s.C.shape, kind)
    for node, weight, arm in stencil(model, s.x):
        share = weight[:, None] * v_grid[node]
        v += share
        B += share[:, :, None] * arm[:, None, :]
    C = 4 / model.dx**2 * B
    F = s.F + dt * C @ s.F
    return Moving(s.x + dt * v, v, C, F, relaxed(inputs, s.history, s.F, dt)), taut + branches


def relaxed(inputs: Inputs, history: dict[str, Array], F: Array, dt: float) -> dict[str, Array]:
    """Return what a relaxing stress remembers after a substep that begins at F."""
    return {
        name: (time * relaxed_to + dt * strain(F)) / (time + dt)
        for (name, relaxed_to), (_, time) in zip(history.items(), inputs.terms[0][4:], strict=True)
    }


def rollout(
    model: Model, inputs: Inputs, policy: Policy | None = None
) -> tuple[Records, Moving, list[list[tuple[Any, ...]]]]:
    """Return the probe's records, the last state, and the branches of every substep.

    A policy, if there is one, writes the activations of the inputs as it decides them, and what it last remembers.
    """
    state, memory = inputs.state, inputs.state.memory
    s = Moving(state.x, state.v, state.C, state.F, state.history)
    W = np.zeros((0, len(state.x))) if model.probe is None else model.probe.toarray()
    rows, branches = [], []
    for step in range(model.n_steps):
        if step % model.substeps == 0:
            rows.append(seen(W, s))
            if policy is not None:
                k, here = step // model.substeps, State(s.x, s.v, s.C, s.F, history=s.history)
                what = sight(model, inputs, rows[-1], k)
                inputs.activation[k], memory = policy.act(k, what, memory, lambda now=here: now)
        s, taken = substep(model, inputs, s, step)
        branches.append(taken)
    rows.append(seen(W, s))
    inputs.state.memory = memory
    return recorded(rows), s, branches


def recorded(rows: list[dict[str, Array]]) -> Records:
    """Return records of what was seen at every control step."""
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    x, v, C, F = (arrays.pop(name) for name in "xvCF")
    return Records(x, v, C, F, history=arrays)


def seen(W: Array, s: Moving) -> dict[str, Array]:
    """Return the probe's weighted sums over particles."""
    arrays = {name: getattr(s, name) for name in "xvCF"} | s.history
    return {name: np.einsum("kp,p...->k...", W, a) for name, a in arrays.items()}


def sight(model: Model, inputs: Inputs, record: dict[str, Array], k: int, **more: Any) -> Sight:
    """Return what a policy sees at the start of control step k."""
    before = inputs.activation[k - 1] if k else np.zeros(len(model.actuators))
    return Sight(
        flat(record), activation=before, strength=inputs.strength, rest_length=inputs.rest, friction=inputs.friction,
        **more,
    )  # fmt: skip


def flat(record: dict[str, Array]) -> Array:
    """Return the sums as the engine's rows (rows, K): x, v, C, F, row-major, and the history."""
    return np.concatenate([record[name].reshape(len(record["x"]), -1) for name in record], axis=1).T
