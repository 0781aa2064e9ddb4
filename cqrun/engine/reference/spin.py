"""The free motion of a rigid body in a substep, on the momenta after it, and its adjoint.

The kinetic energy of rotation is split (A. Dullweber et al., J. Chem. Phys. 107 (1997)): |L|^2 / (2 I_2) turns the body
about the angular momentum L, and (1 / I_i - 1 / I_2) L_i^2 / 2 turns it about its own axis i by an angle that this turn
does not change. Each turn is exact and leaves L alone. Axes 1, 3 and 1 again are turned by a half, a whole and a half.

The cotangent of a rotation is a vector theta_bar in the world, R' = R + [dtheta]x R.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.boundaries.solid import ZERO, cross
from cqrun.engine.reference.facet import row
from cqrun.engine.reference.grip import turn
from cqrun.engine.reference.moves import SMALL
from cqrun.numerics.compile import kernel
from cqrun.numerics.tensor import add, dot, scale, sub
from cqrun.plugin.contract import Array

ORDER = (0, 2, 0)
"""The axes that are turned about, in order; their shares of dt are `SHARES`."""

SHARES = (0.5, 1.0, 0.5)


@kernel
def times(p: Any, q: Any) -> Any:
    """Return the product of two quaternions."""
    u, v = (p[1], p[2], p[3]), (q[1], q[2], q[3])
    w = add(add(scale(v, p[0]), scale(u, q[0])), cross(u, v))
    return p[0] * q[0] - dot(u, v), w[0], w[1], w[2]


@kernel
def exponential(theta: Any) -> Any:
    """Return the quaternion of a rotation vector."""
    square = dot(theta, theta)
    if square < SMALL:
        c, s = 1.0 - square / 8.0 + square**2 / 384.0, 0.5 - square / 48.0 + square**2 / 3840.0
    else:
        phi = np.sqrt(square)
        c, s = np.cos(0.5 * phi), np.sin(0.5 * phi) / phi
    return c, s * theta[0], s * theta[1], s * theta[2]


@kernel
def jacobian_vjp(theta: Any, bar: Any) -> Any:
    """Return J^T bar, with exp(theta + d) = exp(J d) exp(theta): J = I + b [theta]x + c [theta]x^2."""
    square = dot(theta, theta)
    if square < SMALL:
        b, c = 0.5 - square / 24.0 + square**2 / 720.0, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0
    else:
        phi = np.sqrt(square)
        b, c = (1.0 - np.cos(phi)) / square, (phi - np.sin(phi)) / (square * phi)
    once = cross(theta, bar)
    return add(sub(bar, scale(once, b)), scale(cross(theta, once), c))


@kernel
def spin(axes: Array, inertia: Any, q: Any, L: Any, dt: float) -> Any:
    """Return the quaternion after a substep."""
    for k in range(3):
        q = about_axis(axes, inertia, q, L, dt, k)
    return times(exponential(scale(L, dt / inertia[1])), q)


@kernel
def about_axis(axes: Array, inertia: Any, q: Any, L: Any, dt: float, k: int) -> Any:
    """Return the quaternion after the k-th turn about an axis of the body."""
    e = row(axes, ORDER[k])
    angle = dt * SHARES[k] * (1.0 / inertia[ORDER[k]] - 1.0 / inertia[1]) * dot(turn(q, e), L)
    c, s = np.cos(0.5 * angle), np.sin(0.5 * angle)
    return times(q, (c, s * e[0], s * e[1], s * e[2]))


@kernel
def spin_vjp(axes: Array, inertia: Any, q: Any, L: Any, dt: float, bar: Any) -> Any:
    """Return (theta_bar, L_bar, inertia_bar) from the cotangent of the rotation after a substep."""
    w = scale(L, dt / inertia[1])
    w_bar = jacobian_vjp(w, bar)
    first, middle, last = 0.0, -dt * dot(L, w_bar) / inertia[1] ** 2, 0.0
    L_bar = scale(w_bar, dt / inertia[1])
    E = exponential(w)
    theta_bar = turn((E[0], -E[1], -E[2], -E[3]), bar)
    q_1 = about_axis(axes, inertia, q, L, dt, 0)
    q_2 = about_axis(axes, inertia, q_1, L, dt, 1)
    for k in range(2, -1, -1):
        e = turn(q, row(axes, ORDER[k]))
        if k == 1:
            e = turn(q_1, row(axes, ORDER[k]))
        if k == 2:
            e = turn(q_2, row(axes, ORDER[k]))
        share, along, rate = dt * SHARES[k], dot(e, L), 1.0 / inertia[ORDER[k]] - 1.0 / inertia[1]
        angle_bar = dot(e, theta_bar)
        theta_bar = add(theta_bar, scale(cross(e, L), share * rate * angle_bar))
        L_bar = add(L_bar, scale(e, share * rate * angle_bar))
        more = -share * along * angle_bar / inertia[ORDER[k]] ** 2
        if ORDER[k] == 0:
            first += more
        else:
            last += more
        middle += share * along * angle_bar / inertia[1] ** 2
    return theta_bar, L_bar, (first, middle, last)


@kernel
def angular_velocity(axes: Array, inertia: Any, q: Any, L: Any) -> Any:
    """Return w = sum_i e_i (e_i . L) / I_i."""
    w = ZERO
    for i in range(3):
        e = turn(q, row(axes, i))
        w = add(w, scale(e, dot(e, L) / inertia[i]))
    return w


@kernel
def angular_velocity_vjp(axes: Array, inertia: Any, q: Any, L: Any, w_bar: Any) -> Any:
    """Return (theta_bar, L_bar, inertia_bar)."""
    theta_bar, L_bar, a, b, c = ZERO, ZERO, 0.0, 0.0, 0.0
    for i in range(3):
        e, I = turn(q, row(axes, i)), inertia[i]
        along, slope = dot(e, L), dot(e, w_bar)
        theta_bar = add(theta_bar, add(scale(cross(e, w_bar), along / I), scale(cross(e, L), slope / I)))
        L_bar = add(L_bar, scale(e, slope / I))
        more = -along * slope / I**2
        if i == 0:
            a = more
        elif i == 1:
            b = more
        else:
            c = more
    return theta_bar, L_bar, (a, b, c)
