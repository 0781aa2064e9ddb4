"""Contact of surface points with obstacles in a substep, and its adjoint.

Threads share the points near obstacles, then the nodes that move one of them; each node adds the forces of its points
in a fixed order. The tangential springs are rows of the state after those of the nodes: spring j is in row M + j // 2
of u, or of v if j is odd.
"""

from __future__ import annotations

from typing import Any

from cqrun.boundaries.solid import ZERO, cross
from cqrun.engine.reference.contact import Contact, Pushes
from cqrun.engine.reference.facet import row
from cqrun.engine.reference.grip import (
    beyond_margin,
    clear_grip_each,
    mark_poses_each,
    moment_arm,
    note_grip_each,
    relative_velocity,
    surface_at,
    with_grip_force_bar,
    with_grip_place_bar,
)
from cqrun.engine.reference.movers import (
    add_weight_bars,
    farthest,
    list_movers,
    load_spring,
    place,
    places,
    put,
    set_mark,
    share_out,
    store_spring,
)
from cqrun.engine.reference.rub import push, push_vjp, rub, rub_vjp
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import barrier, for_each, for_one, kernel, share
from cqrun.numerics.tensor import add, dot, scale, sub
from cqrun.plugin.contract import Array

FAR = 1e300


@kernel
def watch(contact: Contact, run: NodeRun, u: Array, crew: Crew) -> bool:
    """Find the points near obstacles again if nodes have moved too far; return whether that was done."""
    near, points = contact.near, contact.surface.points
    most = farthest(points, u, near.mark, crew)
    near.moved[crew.thread] = most
    barrier(run.arrivals, crew.n_threads)
    for thread in range(crew.n_threads):
        most = max(most, near.moved[thread])
    if not beyond_margin(contact.rigid, near, most):
        return False
    set_mark(points, u, near.mark, crew)
    lo, hi = share(len(near.flag), crew.thread, crew.n_threads)
    for s in range(lo, hi):
        x, least = add(row(contact.surface.rest, s), place(points, s, u, 1, 0)), FAR
        for o in range(len(contact.obstacles.dashpot)):
            least = min(least, surface_at(contact.rigid, contact.obstacles, o, x)[0])
        near.flag[s] = least < near.margin
    barrier(run.arrivals, crew.n_threads)
    if crew.thread == 0:
        count = 0
        for s in range(len(near.flag)):
            if near.flag[s]:
                near.points[count] = s
                count += 1
        near.count[0] = count
        list_movers(near.movers, points, near.flag)
        mark_poses_each(contact.rigid)
    barrier(run.arrivals, crew.n_threads)
    return True


@kernel
def press_point(contact: Contact, s: int, x: Any, v: Any, spring: Any, dt: float) -> Any:
    """Return the force on a point, its spring after the substep, and whether more than x matters."""
    surface, obstacles = contact.surface, contact.obstacles
    K, Z, h0 = surface.stiffness[s], surface.impedance[s], surface.onset
    force, after, slid, deepest, normal, pressed, mu, along = ZERO, ZERO, False, 0.0, ZERO, 0.0, 0.0, v
    for o in range(len(obstacles.dashpot)):
        d, n, _, _ = surface_at(contact.rigid, obstacles, o, x)
        if d < 0.0:
            C, speed = Z * obstacles.dashpot[o], relative_velocity(contact.rigid, o, x, v)
            N = push(K, C, h0, -d, -dot(n, speed))
            if N > 0.0:
                force = add(force, scale(n, N))
                slid = slid or C > 0.0
                if obstacles.rubs[o] and -d > deepest:
                    deepest, normal, pressed, mu, along = -d, n, N, obstacles.coefficient[o], speed
    if deepest > 0.0:
        after = rub(K, mu, pressed, dt, normal, along, spring)
        force = sub(force, scale(after, K))
        slid = True
    return force, after, slid


@kernel
def note_push(pushes: Pushes, contact: Contact, s: int, x: Any, v: Any, after: Any) -> None:
    """Add what each obstacle does to a point in a substep to the sums; see `press_point`."""
    surface, obstacles, deepest, rubs = contact.surface, contact.obstacles, 0.0, -1
    K, Z, h0 = surface.stiffness[s], surface.impedance[s], surface.onset
    for o in range(len(obstacles.dashpot)):
        d, n, _, _ = surface_at(contact.rigid, obstacles, o, x)
        if d < 0.0:
            N = push(K, Z * obstacles.dashpot[o], h0, -d, -dot(n, relative_velocity(contact.rigid, o, x, v)))
            if N > 0.0:
                add_push(pushes, s, o, moment_arm(contact.rigid, o, x), scale(n, N))
                if obstacles.rubs[o] and -d > deepest:
                    deepest, rubs = -d, o
    if rubs >= 0:
        add_push(pushes, s, rubs, moment_arm(contact.rigid, rubs, x), scale(after, -K))


@kernel
def add_push(pushes: Pushes, s: int, o: int, a: Any, f: Any) -> None:
    """Add a force with the arm a, and its moment."""
    moment = cross(a, f)
    for d in range(3):
        pushes.sums[s, o, d] += f[d]
        pushes.sums[s, o, 3 + d] += moment[d]


@kernel
def force_bar_of(pushes: Pushes, force_bar: Any, o: int, a: Any, control: int) -> Any:
    """Return the cotangent of an obstacle's force on a point at x: that of the point, and that of its reaction."""
    if pushes.owner[o] < 0:
        return force_bar
    R = pushes.mean_bar[control, pushes.owner[o]]
    more = add((R[0], R[1], R[2]), cross((R[3], R[4], R[5]), a))
    return add(force_bar, scale(more, pushes.per))


@kernel
def place_bar_of(pushes: Pushes, x_bar: Any, o: int, f: Any, control: int) -> Any:
    """Return the cotangent of a point's position with that of the arm of an obstacle's force."""
    if pushes.owner[o] < 0:
        return x_bar
    R = pushes.mean_bar[control, pushes.owner[o]]
    return add(x_bar, scale(cross(f, (R[3], R[4], R[5])), pushes.per))


@kernel
def same_force_bar(force_bar: Any, o: int, a: Any, control: int) -> Any:
    """Return what `force_bar_of` returns if no reactions are recorded."""
    return force_bar


@kernel
def same_place_bar(x_bar: Any, o: int, f: Any, control: int) -> Any:
    """Return what `place_bar_of` returns if no reactions are recorded."""
    return x_bar


note_push_each = for_each(note_push)
own_force_bar, own_place_bar = for_one(force_bar_of, same_force_bar), for_one(place_bar_of, same_place_bar)


@kernel
def touch(contact: Contact, run: NodeRun, at: NodeStep, u_next: Array, keep: bool, crew: Crew) -> None:
    """Add the forces of obstacles to `run.force`, and write the springs after the substep."""
    surface, obstacles, near, first = contact.surface, contact.obstacles, contact.near, len(run.nodes.mass)
    changed = watch(contact, run, at.u, crew)
    if keep or changed:
        relax_others(contact, first, u_next, at.v_next, crew)
    if near.count[0] == 0:
        return
    lo, hi = share(near.count[0], crew.thread, crew.n_threads)
    for index in range(lo, hi):
        s, spring = near.points[index], ZERO
        x, v = places(surface.points, surface.rest, s, at.u, at.v)
        if obstacles.springs > 0:
            spring = load_spring(at.u, at.v, first, s)
        force, after, slid = press_point(contact, s, x, v, spring, run.setting.dt)
        put(contact.force, s, force)
        note_push_each(contact.pushes, contact, s, x, v, after)
        note_grip_each(contact.rigid, contact, s, x, v, after)
        if obstacles.springs > 0:
            store_spring(u_next, at.v_next, first, s, after)
        if slid:
            contact.slid[crew.thread] = 1
    barrier(run.arrivals, crew.n_threads)
    share_out(contact.near.movers, contact.force, run.force, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)


@kernel
def relax_others(contact: Contact, first: int, u: Array, v: Array, crew: Crew) -> None:
    """Set the springs of all points that are not near to zero."""
    if contact.obstacles.springs > 0:
        lo, hi = share(len(contact.near.flag), crew.thread, crew.n_threads)
        for s in range(lo, hi):
            if not contact.near.flag[s]:
                store_spring(u, v, first, s, ZERO)


@kernel
def press_point_vjp(
    contact: Contact, s: int, x: Any, v: Any, spring: Any, dt: float, control: int, force_bar: Any, after_bar: Any
) -> Any:
    """Return (x_bar, v_bar, spring_bar), and add to the cotangents of the coefficients of friction.

    The cotangents of reactions in this control step count, too.
    """
    surface, obstacles = contact.surface, contact.obstacles
    K, Z, h0 = surface.stiffness[s], surface.impedance[s], surface.onset
    x_bar, v_bar, spring_bar, deepest, rubs, pressed = ZERO, ZERO, ZERO, 0.0, -1, 0.0
    clear_grip_each(contact.rigid, s)
    for o in range(len(obstacles.dashpot)):
        d, n, _, _ = surface_at(contact.rigid, obstacles, o, x)
        if obstacles.rubs[o] and d < 0.0 and -d > deepest:
            N = push(K, Z * obstacles.dashpot[o], h0, -d, -dot(n, relative_velocity(contact.rigid, o, x, v)))
            if N > 0.0:
                deepest, rubs, pressed = -d, o, N
    for o in range(len(obstacles.dashpot)):
        d, n, alpha, t = surface_at(contact.rigid, obstacles, o, x)
        if not d < 0.0:
            continue
        C, speed = Z * obstacles.dashpot[o], relative_velocity(contact.rigid, o, x, v)
        rate = -dot(n, speed)
        N = push(K, C, h0, -d, rate)
        if not N > 0.0:
            continue
        N_bar, n_bar, speed_bar, f = 0.0, ZERO, ZERO, scale(n, N)
        own_bar = own_force_bar(contact.pushes, force_bar, o, moment_arm(contact.rigid, o, x), control)
        own_bar = with_grip_force_bar(contact.rigid, own_bar, o, x)
        if o == rubs:
            mu = obstacles.coefficient[o]
            out_bar = sub(after_bar, scale(own_bar, K))
            f = sub(f, scale(rub(K, mu, pressed, dt, n, speed, spring), K))
            mu_bar, N_bar, n_bar, speed_bar, spring_bar = rub_vjp(K, mu, pressed, dt, n, speed, spring, out_bar)
            contact.friction_bar[s, o] += mu_bar
            v_bar = add(v_bar, speed_bar)
        N_bar += dot(n, own_bar)
        n_bar = add(n_bar, scale(own_bar, N))
        h_bar, rate_bar = push_vjp(K, C, h0, -d, rate, N_bar)
        v_bar = sub(v_bar, scale(n, rate_bar))
        speed_bar = sub(speed_bar, scale(n, rate_bar))
        n_bar = sub(n_bar, scale(speed, rate_bar))
        turned = sub(sub(n_bar, scale(n, dot(n, n_bar))), scale(t, dot(t, n_bar)))
        y_bar = sub(scale(turned, alpha), scale(n, h_bar))
        x_bar = own_place_bar(contact.pushes, add(x_bar, y_bar), o, f, control)
        arm_bar = own_place_bar(contact.pushes, ZERO, o, f, control)
        x_bar = with_grip_place_bar(contact.rigid, s, o, x, x_bar, f, y_bar, n, n_bar, speed_bar, arm_bar)
    return x_bar, v_bar, spring_bar


@kernel
def touch_vjp(contact: Contact, run: NodeRun, bars: NodeBars, at: NodeStep, reversed_: bool, crew: Crew) -> None:
    """Run the adjoint at bars.pairs: add to the cotangents of displacements in `bars.sums`, and to those of springs.

    In a reversed run, the forces are added to the second record of a node, as in `press_unit_vjp`. The cotangents of
    velocities wait for `touch_rates_vjp`.
    """
    surface, obstacles, near, first = contact.surface, contact.obstacles, contact.near, len(run.nodes.mass)
    if watch(contact, run, at.u, crew):
        relax_others(contact, first, bars.u, bars.v, crew)
    if near.count[0] == 0:
        return
    lo, hi = share(near.count[0], crew.thread, crew.n_threads)
    for index in range(lo, hi):
        s, spring, after_bar = near.points[index], ZERO, ZERO
        x, v = places(surface.points, surface.rest, s, at.u, at.v)
        force_bar = place(surface.points, s, bars.pairs, 2, 1)
        if obstacles.springs > 0:
            spring, after_bar = load_spring(at.u, at.v, first, s), load_spring(bars.u, bars.v, first, s)
        if reversed_:
            put(contact.force, s, press_point(contact, s, x, v, spring, run.setting.dt)[0])
        x_bar, v_bar, spring_bar = press_point_vjp(
            contact, s, x, v, spring, run.setting.dt, at.control, force_bar, after_bar
        )
        if len(contact.bars.rest) > 0:
            force = press_point(contact, s, x, v, spring, run.setting.dt)[0]
            add_weight_bars(surface.points, contact.bars, s, at, bars.pairs, x_bar, v_bar, force)
        put(contact.u_bar, s, x_bar)
        put(contact.v_bar, s, v_bar)
        if obstacles.springs > 0:
            store_spring(bars.u, bars.v, first, s, spring_bar)
    barrier(run.arrivals, crew.n_threads)
    share_out(contact.near.movers, contact.u_bar, bars.sums, 2, 0, crew)
    if reversed_:
        share_out(contact.near.movers, contact.force, bars.sums, 2, 1, crew)
    barrier(run.arrivals, crew.n_threads)


@kernel
def touch_rates_vjp(contact: Contact, run: NodeRun, bars: NodeBars, crew: Crew) -> None:
    """Add the cotangents of velocities, which `touch_vjp` has found."""
    share_out(contact.near.movers, contact.v_bar, bars.v, 1, 0, crew)
    barrier(run.arrivals, crew.n_threads)


touch_each = for_each(touch)
touch_each_vjp = for_each(touch_vjp)
touch_rates_each_vjp = for_each(touch_rates_vjp)
