"""How rigid bodies move in a substep, and the adjoint.

    p' = p + dt (F + F_c),   c' = c + dt p' / m - dt^2 F / (2 m),   L' = L + dt (M + M_c),   q' by L' (`spin.py`)

with the constant force F and torque M, and F_c and M_c from contact, about the centre before the substep. So free
flight is an exact parabola, and what soft and rigid bodies give each other is balanced to rounding.

Points on the skin of a free body touch the obstacles of boundaries by the law of soft surfaces (`touch.press_point`).
What acts on a body is added up in the order of its points, so that the bits do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

from cqrun.boundaries.solid import ZERO, cross
from cqrun.engine.reference.contact import Contact
from cqrun.engine.reference.facet import row
from cqrun.engine.reference.grip import acting_bar, add_to_pose, quaternion_of, speeds, to_surface, turn
from cqrun.engine.reference.movers import load_spring, put, store_spring
from cqrun.engine.reference.placing import MOMENTS, entries, pass_on, quaternion_at
from cqrun.engine.reference.rigid import Rigid, Skin
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep
from cqrun.engine.reference.spin import spin, spin_vjp
from cqrun.engine.reference.touch import note_push_each, press_point, press_point_vjp
from cqrun.engine.rigid_model import FORCE, MASS, TORQUE
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import barrier, for_each, kernel, share
from cqrun.numerics.tensor import add, scale
from cqrun.plugin.contract import Array

F, M = FORCE.start, TORQUE.start
"""First columns of the force and the torque."""


# --- the skins of free bodies ----------------------------------------------------------------------------------------


@kernel
def is_close(rigid: Rigid, skin: Skin, b: int) -> bool:
    """Return whether a body may touch an obstacle of a boundary; distances outside are lower bounds."""
    for o in range(len(skin.obstacles.dashpot)):
        if to_surface(skin.obstacles, o, entries(rigid.pose, b, 0))[0] < rigid.radius[b]:
            return True
    return False


@kernel
def on_skin(rigid: Rigid, b: int, k: int) -> Any:
    """Return the arm, the position and the velocity of a point on a body's skin."""
    V, w = speeds(rigid, b)
    r = turn(quaternion_of(rigid, b), row(rigid.skin_rest, k))
    return r, add(entries(rigid.pose, b, 0), r), add(V, cross(w, r))


@kernel
def touch_skin(skin: Skin, rigid: Rigid, run: NodeRun, at: NodeStep, u_next: Array, crew: Crew) -> None:
    """Find force and moment on each point of the skins, and write its spring after the substep."""
    first = len(run.nodes.mass)
    for b in range(len(rigid.row)):
        close = is_close(rigid, skin, b)
        lo, hi = share(rigid.skin_begin[b + 1] - rigid.skin_begin[b], crew.thread, crew.n_threads)
        for k in range(rigid.skin_begin[b] + lo, rigid.skin_begin[b] + hi):
            spring, force, after, r = ZERO, ZERO, ZERO, ZERO
            if close:
                r, x, v = on_skin(rigid, b, k)
                if skin.obstacles.springs > 0:
                    spring = load_spring(at.u, at.v, first, skin.first + k)
                force, after, _ = press_point(skin, k, x, v, spring, run.setting.dt)
                note_push_each(skin.pushes, skin, k, x, v, after)
            if skin.obstacles.springs > 0:
                store_spring(u_next, at.v_next, first, skin.first + k, after)
            moment = cross(r, force)
            for d in range(3):
                skin.force[k, d], skin.force[k, 3 + d] = force[d], moment[d]
    barrier(run.arrivals, crew.n_threads)


@kernel
def touch_skin_vjp(skin: Skin, rigid: Rigid, run: NodeRun, bars: NodeBars, at: NodeStep, crew: Crew) -> None:
    """Run the adjoint at `rigid.bars.acting`: write the cotangents of poses, and those of the springs before."""
    first = len(run.nodes.mass)
    for b in range(len(rigid.row)):
        close = is_close(rigid, skin, b)
        F_bar, M_bar = acting_bar(rigid, b)
        _, w = speeds(rigid, b)
        lo, hi = share(rigid.skin_begin[b + 1] - rigid.skin_begin[b], crew.thread, crew.n_threads)
        for k in range(rigid.skin_begin[b] + lo, rigid.skin_begin[b] + hi):
            spring, after_bar, spring_bar = ZERO, ZERO, ZERO
            skin.pose_bar[k] = 0.0
            if close:
                r, x, v = on_skin(rigid, b, k)
                if skin.obstacles.springs > 0:
                    spring = load_spring(at.u, at.v, first, skin.first + k)
                    after_bar = load_spring(bars.u, bars.v, first, skin.first + k)
                force = press_point(skin, k, x, v, spring, run.setting.dt)[0]
                x_bar, v_bar, spring_bar = press_point_vjp(
                    skin, k, x, v, spring, run.setting.dt, at.control, add(F_bar, cross(M_bar, r)), after_bar
                )
                r_bar = add(add(x_bar, cross(force, M_bar)), cross(v_bar, w))
                add_to_pose(skin.pose_bar, k, 0, x_bar)
                add_to_pose(skin.pose_bar, k, 3, cross(r, r_bar))
                add_to_pose(skin.pose_bar, k, 6, v_bar)
                add_to_pose(skin.pose_bar, k, 9, cross(r, v_bar))
            if skin.obstacles.springs > 0:
                store_spring(bars.u, bars.v, first, skin.first + k, spring_bar)
    barrier(run.arrivals, crew.n_threads)


@kernel
def add_skin(skin: Skin, rigid: Rigid, b: int) -> None:
    """Add what acts on the points of a body's skin."""
    for k in range(rigid.skin_begin[b], rigid.skin_begin[b + 1]):
        for d in range(6):
            rigid.total[b, d] += skin.force[k, d]


@kernel
def add_skin_bars(skin: Skin, rigid: Rigid, b: int) -> None:
    """Add the cotangents of a body's pose from the points of its skin."""
    for k in range(rigid.skin_begin[b], rigid.skin_begin[b + 1]):
        for d in range(12):
            rigid.bars.total[b, d] += skin.pose_bar[k, d]


touch_skin_each, touch_skin_each_vjp = for_each(touch_skin), for_each(touch_skin_vjp)
add_skin_each, add_skin_bars_each = for_each(add_skin), for_each(add_skin_bars)


# --- a substep -------------------------------------------------------------------------------------------------------


@kernel
def ride(rigid: Rigid, contact: Contact, run: NodeRun, at: NodeStep, u_next: Array, crew: Crew) -> None:
    """Move the free bodies by a substep, after `touch` has found the forces on points."""
    touch_skin_each(rigid.skin, rigid, run, at, u_next, crew)
    lo, hi = share(len(rigid.row), crew.thread, crew.n_threads)
    for b in range(lo, hi):
        if rigid.row[b] >= 0:
            add_up_forces(rigid, contact, b)
            move(rigid, run, at, u_next, b)
    barrier(run.arrivals, crew.n_threads)


@kernel
def add_up_forces(rigid: Rigid, contact: Contact, b: int) -> None:
    """Add up what acts on a body, in the order of the points."""
    rigid.total[b] = 0.0
    for index in range(contact.near.count[0]):
        for d in range(6):
            rigid.total[b, d] -= rigid.force[contact.near.points[index], b, d]
    add_skin_each(rigid.skin, rigid, b)


@kernel
def move(rigid: Rigid, run: NodeRun, at: NodeStep, u_next: Array, b: int) -> None:
    """Write a free body's rows after a substep."""
    r, dt, number, total = rigid.row[b], run.setting.dt, rigid.number, rigid.total
    m, q = number[b, MASS], quaternion_at(at.u, r)
    L = add(entries(at.v, r + 1, 0), scale(add(entries(number, b, M), entries(total, b, 3)), dt))
    for d in range(3):
        p = at.v[r, d] + dt * (number[b, F + d] + total[b, d])
        u_next[r, d] = at.u[r, d] + dt * p / m - 0.5 * dt * dt * number[b, F + d] / m
        at.v_next[r, d] = p
    q = spin(rigid.axes[b], entries(number, b, MOMENTS), q, L, dt)
    put(at.v_next, r + 1, L)
    for d in range(4):
        u_next[r + 1, d] = q[d]


@kernel
def ride_all(contact: Contact, run: NodeRun, at: NodeStep, u_next: Array, crew: Crew) -> None:
    """Move the free bodies of a contact, if it has any."""
    ride_each(contact.rigid, contact, run, at, u_next, crew)


ride_each = for_each(ride)
ride_all_each = for_each(ride_all)


# --- its adjoint -----------------------------------------------------------------------------------------------------


@kernel
def ride_vjp(rigid: Rigid, run: NodeRun, bars: NodeBars, at: NodeStep, crew: Crew) -> None:
    """Turn the cotangents of free bodies' rows into those before the substep, but for contact; then that of skins."""
    lo, hi = share(len(rigid.row), crew.thread, crew.n_threads)
    for b in range(lo, hi):
        rigid.bars.acting[b] = 0.0
        if rigid.row[b] >= 0:
            move_vjp(rigid, run, bars, at, b)
    barrier(run.arrivals, crew.n_threads)
    touch_skin_each_vjp(rigid.skin, rigid, run, bars, at, crew)


@kernel
def move_vjp(rigid: Rigid, run: NodeRun, bars: NodeBars, at: NodeStep, b: int) -> None:
    """Run the adjoint of `move`: change the rows of `bars`, and write the cotangents of what acts on the body."""
    r, dt, number, bar, acting = rigid.row[b], run.setting.dt, rigid.number, rigid.bars.number, rigid.bars.acting
    m, inertia = number[b, MASS], entries(number, b, MOMENTS)
    theta_bar, L_bar, inertia_bar = spin_vjp(
        rigid.axes[b], inertia, quaternion_at(at.u, r), entries(at.v_next, r + 1, 0), dt, entries(bars.u, r + 1, 0)
    )
    for d in range(3):
        c_bar, p, force = bars.u[r, d], at.v_next[r, d], number[b, F + d]
        p_bar = bars.v[r, d] + dt * c_bar / m
        bar[b, MASS] -= c_bar * (dt * p - 0.5 * dt * dt * force) / m**2
        bar[b, F + d] += dt * p_bar - 0.5 * dt * dt * c_bar / m
        bars.v[r, d] = p_bar
        acting[b, d] = dt * p_bar
        L = bars.v[r + 1, d] + L_bar[d]
        bars.v[r + 1, d] = L
        bar[b, M + d] += dt * L
        acting[b, 3 + d] = dt * L
        bars.u[r + 1, d] = theta_bar[d]
        bar[b, MOMENTS + d] += inertia_bar[d]


@kernel
def settle_poses(
    rigid: Rigid, contact: Contact, run: NodeRun, bars: NodeBars, at: NodeStep, step: int, crew: Crew
) -> None:
    """Add up the cotangents of the poses before a substep, in the order of the points, after `touch_vjp`."""
    lo, hi = share(len(rigid.row), crew.thread, crew.n_threads)
    for b in range(lo, hi):
        rigid.bars.total[b] = 0.0
        for index in range(contact.near.count[0]):
            for d in range(12):
                rigid.bars.total[b, d] += rigid.bars.pose[contact.near.points[index], b, d]
        add_skin_bars_each(rigid.skin, rigid, b)
        pass_on(rigid, bars, at.u, at.v, b, step, rigid.bars.total)
    barrier(run.arrivals, crew.n_threads)


@kernel
def ride_all_vjp(contact: Contact, run: NodeRun, bars: NodeBars, at: NodeStep, crew: Crew) -> None:
    """Run `ride_vjp` for the rigid bodies of a contact, if it has any."""
    ride_each_vjp(contact.rigid, run, bars, at, crew)


@kernel
def settle_all_poses(contact: Contact, run: NodeRun, bars: NodeBars, at: NodeStep, step: int, crew: Crew) -> None:
    """Run `settle_poses` for the rigid bodies of a contact, if it has any."""
    settle_poses_each(contact.rigid, contact, run, bars, at, step, crew)


ride_each_vjp, settle_poses_each = for_each(ride_vjp), for_each(settle_poses)
ride_all_each_vjp, settle_all_poses_each = for_each(ride_all_vjp), for_each(settle_all_poses)
