"""Poses of rigid bodies in NumPy: rotations, the tables of paths, and the rows of free bodies at the start.

A pose has the centre c (3), the quaternion q (4), the velocity V (3) and the angular velocity w (3), all in the world.
The cotangent of a rotation is a vector theta_bar in the world: R' = R + [dtheta]x R. So that of a pose has 12 numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cqrun.engine.model import Model
from cqrun.engine.reference.moves import SMALL, STEP, rotation_matrix
from cqrun.engine.rigid_model import INERTIA, MASS, OFFSET, SPIN, VELOCITY, RigidModel
from cqrun.plugin.contract import Array

POSE = 13
POSE_BAR = 12


def quaternion(theta: Array) -> Array:
    """Return the quaternions (..., 4) of rotation vectors (..., 3) [rad], which may be complex."""
    square = (theta * theta).sum(axis=-1)
    small = np.abs(square) < SMALL
    half = 0.5 * np.sqrt(np.where(small, 1.0, square))
    c = np.where(small, 1.0 - square / 8.0 + square**2 / 384.0, np.cos(half))
    s = np.where(small, 0.5 - square / 48.0 + square**2 / 3840.0, 0.5 * np.sin(half) / half)
    return np.concatenate([c[..., None], s[..., None] * theta], axis=-1)


def rotation_vector(q: Array) -> Array:
    """Return the rotation vectors (..., 3) [rad] of quaternions (..., 4), of at most a half turn."""
    q = np.where(q[..., :1] < 0, -q, q)
    length = np.linalg.norm(q[..., 1:], axis=-1)
    angle = 2.0 * np.arctan2(length, q[..., 0])
    return np.asarray(np.where(length > 0, angle / np.where(length > 0, length, 1.0), 2.0)[..., None] * q[..., 1:])


def products(p: Array, q: Array) -> Array:
    """Return the products of quaternions p and q (..., 4)."""
    a, b = p[..., :1], q[..., :1]
    u, v = p[..., 1:], q[..., 1:]
    vector = a * v + b * u + np.cross(u, v)
    return np.concatenate([a * b - (u * v).sum(axis=-1, keepdims=True), vector], axis=-1)


def left_jacobian(theta: Array) -> Array:
    """Return J (..., 3, 3) of rotation vectors: exp(theta + d) = exp(J d) exp(theta)."""
    square = (theta * theta).sum(axis=-1)
    small = square < SMALL
    phi = np.sqrt(np.where(small, 1.0, square))
    b = np.where(small, 0.5 - square / 24.0 + square**2 / 720.0, (1.0 - np.cos(phi)) / phi**2)
    c = np.where(small, 1 / 6 - square / 120.0 + square**2 / 5040.0, (phi - np.sin(phi)) / phi**3)
    W = cross_matrix(theta)
    return np.asarray(np.eye(3) + b[..., None, None] * W + c[..., None, None] * W @ W)


def cross_matrix(a: Array) -> Array:
    """Return [a]x (..., 3, 3)."""
    W = np.zeros((*a.shape[:-1], 3, 3), a.dtype)
    x, y, z = np.moveaxis(a, -1, 0)
    W[..., 0, 1], W[..., 0, 2], W[..., 1, 2] = -z, y, -x
    W[..., 1, 0], W[..., 2, 0], W[..., 2, 1] = z, -y, x
    return W


# --- paths -----------------------------------------------------------------------------------------------------------


def own_waypoints(bodies: tuple[RigidModel, ...]) -> list[slice]:
    """Return which rows of `Inputs.waypoints` each body has."""
    ends = np.cumsum([0, *(len(body.times) for body in bodies)])
    return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]


def _between(times: Array, t: Array) -> Array:
    """Return the share of each waypoint in a path at times t (T, W); before the first, the shape's place counts."""
    known = times if times[0] <= 0.0 else np.concatenate([[0.0], times])
    hats = np.array([np.interp(t, known, row) for row in np.eye(len(known))]).T
    return hats[:, len(known) - len(times) :]


def table_of(body: RigidModel, number: Array, waypoints: Array, t: Array) -> Array:
    """Return the poses (T, 13) of a body at times t (T,), or a single one if it stays where it is.

    Args:
        number: of the body (20,), as in `Inputs.rigid`.
        waypoints: its own (W, 6).
    """
    place = body.center + number[OFFSET]
    if not len(body.times):
        return np.concatenate([place, [1.0], np.zeros(9)])[None]
    course, dt = _between(body.times, t) @ waypoints, t[1] - t[0]
    c = place + course[:, :3]
    V = np.diff(c, axis=0) / dt
    w = spin_between(course[:-1, 3:], course[1:, 3:], dt)
    first = [0, *range(len(V))]  # at the start, the velocity over the first substep
    return np.concatenate([c, quaternion(course[:, 3:]), V[first], w[first]], axis=1)


def spin_between(before: Array, after: Array, dt: float) -> Array:
    """Return the angular velocities (T, 3) from one rotation vector to the next."""
    back = quaternion(before) * np.array([1.0, -1.0, -1.0, -1.0])
    return products(quaternion(after), back)[..., 1:] * (2.0 / dt)


def table_of_vjp(body: RigidModel, waypoints: Array, t: Array, bar: Array) -> tuple[Array, Array]:
    """Return the cotangents of the offset (3,) and of the waypoints (W, 6) from those of the poses (T, 12)."""
    offset_bar = bar[:, :3].sum(axis=0)
    if not len(body.times):
        return offset_bar, np.zeros((0, 6))
    hats, dt = _between(body.times, t), t[1] - t[0]
    course = hats @ waypoints
    course_bar = np.zeros(course.shape)
    course_bar[:, :3] = bar[:, :3]
    course_bar[:, 3:] = np.einsum("tij,ti->tj", left_jacobian(course[:, 3:]), bar[:, 3:6])
    V_bar, w_bar = bar[1:, 6:9].copy(), bar[1:, 9:].copy()
    V_bar[0] += bar[0, 6:9]
    w_bar[0] += bar[0, 9:]
    course_bar[1:, :3] += V_bar / dt
    course_bar[:-1, :3] -= V_bar / dt
    for side in (0, 1):
        for axis in range(3):
            ends = [course[:-1, 3:].astype(complex), course[1:, 3:].astype(complex)]
            ends[side][:, axis] += 1j * STEP
            slope = np.imag(spin_between(*ends, dt)) / STEP
            course_bar[side : len(course) - 1 + side, 3 + axis] += (slope * w_bar).sum(axis=1)
    return offset_bar, hats.T @ course_bar


# --- boundaries that are glued to rigid bodies -----------------------------------------------------------------------


def glued(model: Model) -> Iterator[tuple[int, RigidModel, slice]]:
    """Yield the row of each glued boundary in the table of moves, its rigid body, and the rows of its waypoints."""
    planes = [plane.spec for plane in model.conditions if getattr(plane.spec, "moves", False)]
    places = dict(zip((body.name for body in model.rigid), own_waypoints(model.rigid), strict=True))
    for row, spec in enumerate(planes):
        for body in model.rigid:
            if getattr(spec, "to", None) == body.name and len(body.times):
                yield row, body, places[body.name]


def glue(model: Model, pose: Array, waypoints: Array) -> None:
    """Write displacement and R - I of glued boundaries to the table of moves (P, T + 1, D + D^2)."""
    t, dim = np.arange(pose.shape[1]) * model.dt, model.dim
    for row, body, at in glued(model):
        course = _between(body.times, t) @ waypoints[at]
        turns = course[:, 5:] if dim == 2 else course[:, 3:]
        pose[row] = np.concatenate([course[:, :dim], rotation_matrix(turns).reshape(len(t), -1)], axis=1)


def glue_vjp(model: Model, pose_bar: Array, waypoints: Array) -> Array:
    """Return the cotangent of the waypoints (W, 6) from that of the table of moves; the slopes by a complex step."""
    t, dim, out = np.arange(pose_bar.shape[1]) * model.dt, model.dim, np.zeros(waypoints.shape)
    for row, body, at in glued(model):
        hats = _between(body.times, t)
        course, course_bar = hats @ waypoints[at], np.zeros((len(t), 6))
        course_bar[:, :dim] = pose_bar[row, :, :dim]
        for axis in range(5 if dim == 2 else 3, 6):
            turns = course[:, 3:].astype(complex)
            turns[:, axis - 3] += 1j * STEP
            R = rotation_matrix(turns[:, 2:] if dim == 2 else turns)
            course_bar[:, axis] = (pose_bar[row, :, dim:] * (np.imag(R) / STEP).reshape(len(t), -1)).sum(axis=1)
        out[at] += hats.T @ course_bar
    return out


def first_poses(bodies: tuple[RigidModel, ...], numbers: Array, waypoints: Array) -> list[Array]:
    """Return the pose (13,) of each body at the start; velocities of paths are left out."""
    start, places = np.arange(2.0), own_waypoints(bodies)
    still = [
        table_of(replace(body, times=np.zeros(0)), own, waypoints, start)[0]
        for body, own in zip(bodies, numbers, strict=True)
    ]
    for pose, body, at in zip(still, bodies, places, strict=True):
        if len(body.times) and body.times[0] <= 0.0:
            pose[:3] += waypoints[at][0, :3]
            pose[3:7] = quaternion(waypoints[at][0, 3:])
    return still


# --- free bodies at the start ----------------------------------------------------------------------------------------


def start_rows(body: RigidModel, number: Array) -> tuple[Array, Array]:
    """Return the rows of u and of v (2, 4) each of a free body at the start: c - c0 and q, p and L."""
    u, v = np.zeros((2, 4)), np.zeros((2, 4))
    u[0, :3], u[1, 0] = number[OFFSET], 1.0
    v[0, :3] = number[MASS] * number[VELOCITY]
    v[1, :3] = body.axes.T @ (number[INERTIA] * (body.axes @ number[SPIN]))
    return u, v


def start_rows_vjp(body: RigidModel, number: Array, u_bar: Array, v_bar: Array) -> Array:
    """Return the cotangent of the numbers (20,)."""
    bar, turning = np.zeros(len(number)), body.axes @ v_bar[1, :3]
    bar[OFFSET], bar[VELOCITY] = u_bar[0, :3], number[MASS] * v_bar[0, :3]
    bar[MASS] = number[VELOCITY] @ v_bar[0, :3]
    bar[INERTIA] = turning * (body.axes @ number[SPIN])
    bar[SPIN] = body.axes.T @ (number[INERTIA] * turning)
    return bar
