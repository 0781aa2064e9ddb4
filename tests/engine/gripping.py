"""Rigid bodies of the reference frame in plain NumPy, for complex steps: with rotation matrices, and no quaternions.

A point touches a rigid body as it touches an obstacle (`touching.py`), at c0 + R^T (x - c) and with the velocity
v - V - w x (x - c). A free body moves as

    p' = p + dt (F + F_c),  c' = c + dt p' / m - dt^2 F / 2 m,  L' = L + dt (M + M_c),
    R' = exp(dt L' / I_2) R exp(a_1 e_1 / 2) exp(a_3 e_3) exp(a_1' e_1 / 2),  a_i = dt (1 / I_i - 1 / I_2) R e_i . L'
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from touching import Array, Touching, distance

from cqrun.engine.reference.rub import ONSET
from cqrun.engine.rigid_model import FORCE, FRICTION, INERTIA, MASS, OFFSET, SPIN, TORQUE, VELOCITY


def cross_matrix(a: Array) -> Array:
    """Return [a]x."""
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def rotation(theta: Array) -> Array:
    """Return the matrix of a rotation vector."""
    phi, W = np.sqrt((theta * theta).sum()), cross_matrix(theta)
    if abs(phi) < 1e-4:
        return np.eye(3) + W + W @ W / 2 + W @ W @ W / 6 + W @ W @ W @ W / 24
    return np.eye(3) + np.sin(phi) / phi * W + (1 - np.cos(phi)) / phi**2 * W @ W


def rotation_vector(R: Array) -> Array:
    """Return the rotation vector of a matrix, by a derivative of the angle."""
    w, c = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2, (np.trace(R) - 1) / 2
    if np.abs(w.real).max() < 1e-12:
        return w
    s = np.sqrt((w * w).sum())
    phi = np.arctan2(s.real, c.real)
    return w / s * (phi + 1j * (np.cos(phi) * s.imag - np.sin(phi) * c.imag))


def full(a: Array) -> Array:
    """Return a vector with 3 entries."""
    return np.concatenate([a, np.zeros(3 - len(a))])


@dataclass
class Motion:
    """One body: its pose, and its momenta if it moves freely."""

    c: Array
    R: Array
    V: Array
    w: Array
    p: Array = field(default_factory=lambda: np.zeros(3, complex))
    L: Array = field(default_factory=lambda: np.zeros(3, complex))


@dataclass
class Gripping(Touching):
    """A surface that touches obstacles and rigid bodies, with the motion of these."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.step, self.rows = 0, {body.name: [] for body in self.model.rigid}
        self.skin_springs = [np.zeros((len(body.skin), 3), complex) for body in self.model.rigid]
        self.bodies = [self._start(b) for b in range(len(self.model.rigid))]

    def _start(self, b: int) -> Motion:
        body, number = self.model.rigid[b], self.inputs.rigid[b].astype(complex)
        if not body.free:
            return self._on_path(b, 0)
        inertia = body.axes.T @ np.diag(number[INERTIA]) @ body.axes
        motion = Motion(body.center + number[OFFSET], np.eye(3).astype(complex), number[VELOCITY], number[SPIN])
        motion.p, motion.L = number[MASS] * number[VELOCITY], inertia @ number[SPIN]
        return motion

    def _on_path(self, b: int, step: int) -> Motion:
        body, number, dt = self.model.rigid[b], self.inputs.rigid[b], self.model.dt
        place, zero = body.center + number[OFFSET], np.zeros(3, complex)
        if not len(body.times):
            return Motion(place.astype(complex), np.eye(3).astype(complex), zero, zero)
        (c, R), k = self._course(b, step * dt), max(step, 1)
        (before, R_before), (after, R_after) = self._course(b, (k - 1) * dt), self._course(b, k * dt)
        turned = (
            R_after @ R_before.T
        )  # by the vector part of its quaternion, 2 sin(phi / 2) = 2 sin(phi) / 2 cos(phi / 2)
        half = np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]])
        return Motion(place + c, R, (after - before) / dt, half / np.sqrt(1 + np.trace(turned)) / dt)

    def _course(self, b: int, t: float) -> tuple[Array, Array]:
        first = sum(len(body.times) for body in self.model.rigid[:b])
        times, points = list(self.model.rigid[b].times), self.inputs.waypoints[first:][: len(self.model.rigid[b].times)]
        if times[0] > 0:
            times, points = [0.0, *times], np.concatenate([np.zeros((1, 6)), points])
        at = points[-1] if t >= times[-1] else None
        for (t_0, a), (t_1, z) in itertools.pairwise(zip(times, points, strict=True)):
            if at is None and t <= t_1:
                at = a + (z - a) * (t - t_0) / (t_1 - t_0)
        return at[:3], rotation(at[3:])

    def see(self) -> None:
        """Note the poses after a control step."""
        for b, body in enumerate(self.model.rigid):
            motion = self.bodies[b] if body.free else self._on_path(b, self.step)
            row = [motion.c - body.center, rotation_vector(motion.R), motion.V, motion.w]
            if self.model.dim == 2:
                row = [row[0][:2], row[1][2:], row[2][:2], row[3][2:]]
            self.rows[body.name].append(np.concatenate(row))

    def poses(self) -> dict[str, Array]:
        """Return what was noted, by name."""
        return {name: np.array(rows) for name, rows in self.rows.items()}

    def forces(self, u: Array, v: Array) -> Array:
        """Return the forces on the nodes, and move springs and bodies on by a substep."""
        for b, body in enumerate(self.model.rigid):
            if not body.free:
                self.bodies[b] = self._on_path(b, self.step)
        self.acting = [np.zeros(6, complex) for _ in self.bodies]
        out = super().forces(u, v)
        for b, body in enumerate(self.model.rigid):
            if body.free:
                self._on_skin(b)
        for b, body in enumerate(self.model.rigid):
            if body.free:
                self._move(b)
        self.step += 1
        return out

    def _on_point(self, s: int, x: Array, v: Array, taken: set[tuple[int, str]]) -> Array:
        surface, dim = self.model.surface, self.model.dim
        K, Z = surface.stiffness[s], surface.impedance[s]
        force, after = self._press(full(x), full(v), K, Z, full(self.springs[s]), taken, True)
        self.springs[s] = after[:dim]
        return force[:dim]

    def _press(
        self, x: Array, v: Array, K: float, Z: float, spring: Array, taken: set[tuple[int, str]], bodies: bool
    ) -> tuple[Array, Array]:
        h0, dim, deepest, after, force = ONSET * self.model.dx, self.model.dim, None, np.zeros(3, complex), 0
        kinds = [(o, o.solids, self.inputs.coefficients[o.condition], None) for o in self.model.obstacles]
        if bodies:
            kinds += [(body, body.solids, self.inputs.rigid[b][FRICTION], b) for b, body in enumerate(self.model.rigid)]
        for k, (obstacle, solids, mu, b) in enumerate(kinds):
            y, speed, arm, R = x, v, x, np.eye(3)
            if b is not None:
                motion = self.bodies[b]
                arm, R = x - motion.c, motion.R
                y, speed = obstacle.center + R.T @ arm, v - motion.V - np.cross(motion.w, arm)
            d, n = min((distance(solid, y[:dim]) for solid in solids), key=lambda found: found[0].real)
            n = R @ full(n)
            N = K * -d + Z * obstacle.dashpot * -(speed @ n) * d / (d - h0)
            if d.real < 0 and N.real <= 0:
                taken.add((k, "leaves"))
            if d.real < 0 < N.real:
                taken.add((k, "presses"))
                force = force + N * n
                self._note(k, b, arm, N * n)
                if obstacle.rubs and (deepest is None or -d.real > deepest[0]):
                    deepest = -d.real, n, N, mu, speed, k, b, arm
        if deepest is not None:
            _, n, N, mu, speed, k, b, arm = deepest
            a = spring + self.model.dt * speed
            after = a - n * (n @ a)
            length = np.sqrt((after * after).sum())
            slides = (K * length).real >= (mu * N).real
            taken.add((k, "slides" if slides else "sticks"))
            if slides:
                after = after * mu * N / (K * length)
            force = force - K * after
            self._note(k, b, arm, -K * after)
        return force + np.zeros(3, complex), after

    def _note(self, k: int, b: int | None, arm: Array, f: Array) -> None:
        dim = self.model.dim
        self.pushed.append((k, arm[:dim], f[:dim]))
        if b is not None:
            self.acting[b] -= np.concatenate([f, np.cross(arm, f)])

    def _on_skin(self, b: int) -> None:
        body, motion, taken = self.model.rigid[b], self.bodies[b], set()
        for k, point in enumerate(body.skin):
            r = motion.R @ (point - body.center)
            force, self.skin_springs[b][k] = self._press(
                motion.c + r, motion.V + np.cross(motion.w, r), body.stiffness[k], body.impedance[k],
                self.skin_springs[b][k], taken, False,
            )  # fmt: skip
            self.acting[b] += np.concatenate([force, np.cross(r, force)])
        self.branches[-1] |= {(k, f"skin {what}") for k, what in taken}

    def _move(self, b: int) -> None:
        body, number, dt, motion = self.model.rigid[b], self.inputs.rigid[b], self.model.dt, self.bodies[b]
        m, inertia, R = number[MASS], number[INERTIA], motion.R
        p = motion.p + dt * (number[FORCE] + self.acting[b][:3])
        L = motion.L + dt * (number[TORQUE] + self.acting[b][3:])
        c = motion.c + dt * p / m - dt**2 * number[FORCE] / (2 * m)
        for share, i in ((0.5, 0), (1.0, 2), (0.5, 0)):
            e = body.axes[i]
            R = R @ rotation(share * dt * (1 / inertia[i] - 1 / inertia[1]) * (R @ e @ L) * e)
        R = rotation(dt * L / inertia[1]) @ R
        world = R @ body.axes.T @ np.diag(1 / inertia) @ body.axes @ R.T
        self.bodies[b] = Motion(c, R, p / m, world @ L, p, L)
