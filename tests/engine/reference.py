"""The substep written from the papers' equations in plain NumPy: slow, complex, and sharing no code with the engine.

MLS-MPM with APIC and quadratic B-splines (CQ1 eqs 3-10), a material that is the sum of fixed corotated and
Neo-Hookean elasticity (CQ2 eqs 12, 13), Kelvin-Voigt viscosity, the penalty of CQ2 eq 14 and muscles, the
boundaries of CQ1's supplement XI. Every input may carry an imaginary part of 1e-30, whose image in the output is an
exact derivative (complex step): branches look at real parts alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cqrun.engine.model import Inputs, Model, Records
from cqrun.engine.setting import MARGIN

EPSILON = 1e-7  # of the friction law, both papers

Array = np.ndarray


@dataclass
class Moving:
    """Position, velocity, affine matrix, deformation gradient; real or complex."""

    x: Array
    v: Array
    C: Array
    F: Array


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


def active_stress(model: Model, inputs: Inputs, step: int) -> Array:
    """Return the second Piola-Kirchhoff stress of the muscles, (N, D, D)."""
    n, dim = inputs.state.x.shape
    S = np.zeros((n, dim, dim), np.result_type(inputs.activation, inputs.strength))
    for a, actuator in enumerate(model.actuators):
        tension = inputs.activation[step // model.substeps, a] * inputs.strength[a]
        S[actuator.particles] += tension * matrix(actuator.constants)
    return S


def kirchhoff(model: Model, inputs: Inputs, s: Moving, step: int) -> Array:
    """Return tau of every particle, (N, D, D) [Pa]."""
    (fixed, neo, viscous, penalty), F, eye = inputs.terms[0], s.F, np.eye(model.dim)
    J, F_inv_t = determinant(F)[:, None, None], t(np.linalg.inv(F))
    P = first_piola(*fixed, F, "fixed_corotated") + first_piola(*neo, F, "neo_hookean")
    E, nu = (a[:, None, None] for a in penalty)
    P = P + E / (3 * (2 - 4 * nu)) * 2 * (J - 1) * J * F_inv_t
    P = P + F @ active_stress(model, inputs, step)
    eta, zeta = (a[:, None, None] for a in viscous)
    d = (s.C + t(s.C)) / 2
    tr = np.trace(d, axis1=1, axis2=2)[:, None, None]
    return P @ t(F) + J * (2 * eta * (d - tr / 3 * eye) + zeta * tr * eye)


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


def to_grid(model: Model, inputs: Inputs, s: Moving, step: int) -> tuple[Array, Array]:
    """Return (momentum, mass) of the nodes: CQ1 eqs 3-5, with damping and external forces."""
    dt, fields = model.dt, inputs.fields
    kept = np.exp(-fields.damping * dt) * fields.mass
    tau = kirchhoff(model, inputs, s, step)
    G = kept[:, None, None] * s.C - (4 / model.dx**2) * dt * fields.volume[:, None, None] * tau
    p = kept[:, None] * s.v + dt * fields.force
    kind = np.result_type(G, p, s.x)
    n_nodes = int(np.prod(model.grid_shape))
    mv, m = np.zeros((n_nodes, model.dim), kind), np.zeros(n_nodes, kind)
    for node, weight, arm in stencil(model, s.x):
        np.add.at(m, node, weight * fields.mass)
        np.add.at(mv, node, weight[:, None] * (p + np.einsum("pij,pj->pi", G, arm)))
    return mv, m


def grid_velocity(model: Model, inputs: Inputs, mv: Array, m: Array) -> tuple[Array, list[tuple[int, ...]]]:
    """Return node velocities after the boundaries, and the branch that each held node took."""
    present = m.real > 0
    v = np.zeros_like(mv)
    v[present] = mv[present] / m[present, None]
    branches = []
    for k, condition in enumerate(model.conditions):
        n = np.array(condition.normal)
        for i in np.flatnonzero(condition.nodes & present):
            v[i], branch = after(condition.spec.name, n, inputs.coefficients[k], v[i])
            branches.append((k, int(i), branch))
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


def substep(model: Model, inputs: Inputs, s: Moving, step: int) -> tuple[Moving, list[tuple[int, ...]]]:
    """Return the state after one substep (CQ1 eqs 8-10), and the branches taken on the grid."""
    dt = model.dt
    v_grid, branches = grid_velocity(model, inputs, *to_grid(model, inputs, s, step))
    kind = np.result_type(v_grid, s.x)
    v, B = np.zeros(s.v.shape, kind), np.zeros(s.C.shape, kind)
    for node, weight, arm in stencil(model, s.x):
        share = weight[:, None] * v_grid[node]
        v += share
        B += share[:, :, None] * arm[:, None, :]
    C = 4 / model.dx**2 * B
    return Moving(s.x + dt * v, v, C, s.F + dt * C @ s.F), branches


def rollout(model: Model, inputs: Inputs) -> tuple[Records, Moving, list[list[tuple[int, ...]]]]:
    """Return the probe's records, the last state, and the branches of every substep."""
    state = inputs.state
    s = Moving(state.x, state.v, state.C, state.F)
    rows, branches = [], []
    for step in range(model.n_steps):
        if step % model.substeps == 0:
            rows.append(s)
        s, taken = substep(model, inputs, s, step)
        branches.append(taken)
    rows.append(s)
    W = np.zeros((0, len(state.x))) if model.probe is None else model.probe.toarray()
    recorded = (np.array([np.einsum("kp,p...->k...", W, getattr(r, name)) for r in rows]) for name in "xvCF")
    return Records(*recorded), s, branches
