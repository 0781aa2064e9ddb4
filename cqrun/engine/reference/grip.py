"""Where a surface point meets obstacles that move as rigid bodies, and what they do to each other; the adjoint.

A rigid body is an obstacle with a pose (`rigid.py`). A point at x is at y = c0 + R^T (x - c) of the shape at rest, and
its velocity relative to the surface is v - V - w x (x - c). Functions with a fallback are those of obstacles alone.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.boundaries.solid import cross, signed_distance
from cqrun.engine.reference.contact import Near, Obstacles
from cqrun.engine.reference.facet import row
from cqrun.engine.reference.rigid import Rigid
from cqrun.engine.reference.rub import push
from cqrun.numerics.compile import for_each, for_one, kernel
from cqrun.numerics.tensor import add, dot, scale, sub
from cqrun.plugin.contract import Array


@kernel
def to_surface(obstacles: Obstacles, o: int, x: Any) -> Any:
    """Return (d, n, alpha, t) of an obstacle at x: of the solid in which x is deepest."""
    found = signed_distance(obstacles.solids, obstacles.begin[o], x)
    for k in range(obstacles.begin[o] + 1, obstacles.begin[o + 1]):
        other = signed_distance(obstacles.solids, k, x)
        if other[0] < found[0]:
            found = other
    return found


# --- poses -----------------------------------------------------------------------------------------------------------


@kernel
def turn(q: Any, a: Any) -> Any:
    """Return R a of a unit quaternion q."""
    u = q[1], q[2], q[3]
    b = add(cross(u, a), scale(a, q[0]))
    return add(add(cross(u, b), scale(b, q[0])), scale(u, dot(u, a)))


@kernel
def quaternion_of(rigid: Rigid, b: int) -> Any:
    """Return the quaternion of a body."""
    pose = rigid.pose
    return pose[b, 3], pose[b, 4], pose[b, 5], pose[b, 6]


@kernel
def back(q: Any) -> Any:
    """Return the quaternion of the inverse rotation."""
    return q[0], -q[1], -q[2], -q[3]


@kernel
def arm(rigid: Rigid, b: int, x: Any) -> Any:
    """Return x - c."""
    return x[0] - rigid.pose[b, 0], x[1] - rigid.pose[b, 1], x[2] - rigid.pose[b, 2]


@kernel
def at_rest(rigid: Rigid, b: int, x: Any) -> Any:
    """Return c0 + R^T (x - c)."""
    return add(row(rigid.center, b), turn(back(quaternion_of(rigid, b)), arm(rigid, b, x)))


@kernel
def speeds(rigid: Rigid, b: int) -> Any:
    """Return V and w of a body."""
    pose = rigid.pose
    return (pose[b, 7], pose[b, 8], pose[b, 9]), (pose[b, 10], pose[b, 11], pose[b, 12])


# --- a point ---------------------------------------------------------------------------------------------------------


@kernel
def to_moving_surface(rigid: Rigid, obstacles: Obstacles, o: int, x: Any) -> Any:
    """Return what `to_surface` returns, turned into the world."""
    b = o - rigid.first
    if b < 0:
        return to_surface(obstacles, o, x)
    d, n, alpha, t = to_surface(obstacles, o, at_rest(rigid, b, x))
    q = quaternion_of(rigid, b)
    return d, turn(q, n), alpha, turn(q, t)


@kernel
def relative(rigid: Rigid, o: int, x: Any, v: Any) -> Any:
    """Return the velocity of a point relative to an obstacle."""
    b = o - rigid.first
    if b < 0:
        return v
    V, w = speeds(rigid, b)
    return sub(sub(v, V), cross(w, arm(rigid, b, x)))


@kernel
def arm_of_moment(rigid: Rigid, o: int, x: Any) -> Any:
    """Return the arm of the moment of an obstacle's force: from a rigid body's centre, else from the world's origin."""
    b = o - rigid.first
    return x if b < 0 else arm(rigid, b, x)


@kernel
def same_velocity(o: int, x: Any, v: Any) -> Any:
    """Return what `relative` returns without rigid bodies."""
    return v


@kernel
def same_arm(o: int, x: Any) -> Any:
    """Return what `arm_of_moment` returns without rigid bodies."""
    return x


surface_at = for_one(to_moving_surface, to_surface)
relative_velocity = for_one(relative, same_velocity)
moment_arm = for_one(arm_of_moment, same_arm)


@kernel
def note_grip(rigid: Rigid, contact: Any, s: int, x: Any, v: Any, after: Any) -> None:
    """Keep force and moment of each rigid body on a point; see `touch.press_point`."""
    surface, obstacles, deepest, rubs = contact.surface, contact.obstacles, 0.0, -1
    K, Z, h0 = surface.stiffness[s], surface.impedance[s], surface.onset
    rigid.force[s] = 0.0
    for o in range(len(obstacles.dashpot)):
        d, n, _, _ = to_moving_surface(rigid, obstacles, o, x)
        if d < 0.0:
            N = push(K, Z * obstacles.dashpot[o], h0, -d, -dot(n, relative(rigid, o, x, v)))
            if N > 0.0:
                add_force(rigid, s, o, x, scale(n, N))
                if obstacles.rubs[o] and -d > deepest:
                    deepest, rubs = -d, o
    if rubs >= 0:
        add_force(rigid, s, rubs, x, scale(after, -K))


@kernel
def add_force(rigid: Rigid, s: int, o: int, x: Any, f: Any) -> None:
    """Add a force on a point at x, and its moment about the body's centre."""
    b = o - rigid.first
    if b >= 0:
        moment = cross(arm(rigid, b, x), f)
        for d in range(3):
            rigid.force[s, b, d] += f[d]
            rigid.force[s, b, 3 + d] += moment[d]


note_grip_each = for_each(note_grip)


# --- which points are near -------------------------------------------------------------------------------------------


@kernel
def moved_beyond(rigid: Rigid, near: Near, most: float) -> bool:
    """Return whether points and rigid bodies may have used up the margin; `most` is the square of a node's way."""
    way = 0.0
    for b in range(len(rigid.radius)):
        way = max(way, way_of(rigid, b))
    return np.sqrt(most) * (near.margin / near.reach) + way > near.margin


@kernel
def way_of(rigid: Rigid, b: int) -> float:
    """Return how far a surface has moved since its pose was marked: |c - c'| + (angle from q' to q) radius."""
    pose, mark, square, same, other = rigid.pose, rigid.mark, 0.0, 0.0, 0.0
    for d in range(3):
        square += (pose[b, d] - mark[b, d]) ** 2
    for d in range(3, 7):
        same += (pose[b, d] - mark[b, d]) ** 2
        other += (pose[b, d] + mark[b, d]) ** 2
    half = 0.5 * np.sqrt(min(same, other))  # the sine of a quarter of the angle
    return np.sqrt(square) + 4.0 * np.arcsin(min(half, 1.0)) * rigid.radius[b]


@kernel
def node_moved_beyond(near: Near, most: float) -> bool:
    """Return what `moved_beyond` returns without rigid bodies."""
    return most > near.reach**2


@kernel
def mark_poses(rigid: Rigid) -> None:
    """Keep the poses with which points near obstacles are found."""
    for b in range(rigid.pose.shape[0]):
        for d in range(rigid.pose.shape[1]):
            rigid.mark[b, d] = rigid.pose[b, d]


beyond_margin = for_one(moved_beyond, node_moved_beyond)
mark_poses_each = for_each(mark_poses)


# --- its adjoint -----------------------------------------------------------------------------------------------------


@kernel
def clear_grip(rigid: Rigid, s: int) -> None:
    """Set the cotangents of poses from a point to zero."""
    rigid.bars.pose[s] = 0.0


@kernel
def grip_force_bar(rigid: Rigid, force_bar: Any, o: int, x: Any) -> Any:
    """Return the cotangent of a force on a point, with that of the opposite force on a rigid body."""
    b = o - rigid.first
    if b < 0:
        return force_bar
    F, M = acting_bar(rigid, b)
    return sub(sub(force_bar, F), cross(M, arm(rigid, b, x)))


@kernel
def acting_bar(rigid: Rigid, b: int) -> Any:
    """Return the cotangents of force and moment on a body."""
    a = rigid.bars.acting
    return (a[b, 0], a[b, 1], a[b, 2]), (a[b, 3], a[b, 4], a[b, 5])


@kernel
def grip_place_bar(
    rigid: Rigid, s: int, o: int, x: Any, x_bar: Any, f: Any, y_bar: Any, n: Any, n_bar: Any, v_bar: Any, arm_bar: Any
) -> Any:  # fmt: skip
    """Return the cotangent of a point's position with what a rigid obstacle adds, and add to that of its pose.

    Args:
        f: the force on the point.
        y_bar: cotangent of the place at rest, turned into the world; x_bar has it already.
        n_bar, v_bar: those of the normal and of the relative velocity.
        arm_bar: that of the arm of a reaction's moment; x_bar has it already.
    """
    b = o - rigid.first
    if b < 0:
        return x_bar
    _, w = speeds(rigid, b)
    _, M = acting_bar(rigid, b)
    r = arm(rigid, b, x)
    more = sub(cross(w, v_bar), cross(f, M))
    center_bar = add(add(y_bar, arm_bar), more)
    add_to_pose(rigid.bars.pose[s], b, 0, scale(center_bar, -1.0))
    add_to_pose(rigid.bars.pose[s], b, 3, sub(cross(n, n_bar), cross(r, y_bar)))
    add_to_pose(rigid.bars.pose[s], b, 6, scale(v_bar, -1.0))
    add_to_pose(rigid.bars.pose[s], b, 9, cross(v_bar, r))
    return add(x_bar, more)


@kernel
def add_to_pose(bar: Array, b: int, first: int, value: Any) -> None:
    """Add a vector to a part of a body's cotangent."""
    for d in range(3):
        bar[b, first + d] += value[d]


@kernel
def same_grip_force_bar(force_bar: Any, o: int, x: Any) -> Any:
    """Return what `grip_force_bar` returns without rigid bodies."""
    return force_bar


@kernel
def same_grip_place_bar(
    s: int, o: int, x: Any, x_bar: Any, f: Any, y_bar: Any, n: Any, n_bar: Any, v_bar: Any, arm_bar: Any
) -> Any:  # fmt: skip
    """Return what `grip_place_bar` returns without rigid bodies."""
    return x_bar


clear_grip_each = for_each(clear_grip)
with_grip_force_bar = for_one(grip_force_bar, same_grip_force_bar)
with_grip_place_bar = for_one(grip_place_bar, same_grip_place_bar)
