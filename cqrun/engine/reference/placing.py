"""The poses of rigid bodies in a substep and in the records, from the rows of a state or the tables of paths; adjoint.

The rows of a free body have c - c0 and q in u, and p and L in v. In the adjoint, theta_bar stands in the place of
q_bar.
"""

from __future__ import annotations

from typing import Any

from cqrun.engine.reference.contact import Contact
from cqrun.engine.reference.facet import row
from cqrun.engine.reference.grip import at_rest, quaternion_of, to_surface, turn
from cqrun.engine.reference.rigid import Rigid
from cqrun.engine.reference.setting import NodeBars, NodeRun
from cqrun.engine.reference.spin import angular_velocity, angular_velocity_vjp
from cqrun.engine.rigid_model import INERTIA, MASS
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import barrier, for_each, kernel
from cqrun.numerics.tensor import add, dot
from cqrun.plugin.contract import Array

MOMENTS = INERTIA.start
"""First column of the moments of inertia."""

NOWHERE = 1e300
"""Square of a distance beyond all worlds."""


@kernel
def entries(a: Array, b: int, first: int) -> Any:
    """Return three numbers of a row from a column on."""
    return float(a[b, first]), float(a[b, first + 1]), float(a[b, first + 2])


@kernel
def quaternion_at(u: Array, r: int) -> Any:
    """Return the quaternion in the rows of a state that begin at r."""
    return float(u[r + 1, 0]), float(u[r + 1, 1]), float(u[r + 1, 2]), float(u[r + 1, 3])


@kernel
def write_poses(rigid: Rigid, u: Array, v: Array, step: int) -> None:
    """Write the poses of all bodies after a number of substeps."""
    for b in range(len(rigid.row)):
        r = rigid.row[b]
        if r < 0:
            at = min(rigid.begin[b] + step, rigid.begin[b + 1] - 1)
            for d in range(rigid.pose.shape[1]):
                rigid.pose[b, d] = rigid.table[at, d]
        else:
            q, m = quaternion_at(u, r), rigid.number[b, MASS]
            w = angular_velocity(rigid.axes[b], entries(rigid.number, b, MOMENTS), q, entries(v, r + 1, 0))
            for d in range(3):
                rigid.pose[b, d] = rigid.center[b, d] + u[r, d]
                rigid.pose[b, 7 + d] = v[r, d] / m
                rigid.pose[b, 10 + d] = w[d]
            for d in range(4):
                rigid.pose[b, 3 + d] = q[d]


@kernel
def place_bodies(rigid: Rigid, run: NodeRun, u: Array, v: Array, step: int, crew: Crew) -> None:
    """Write the poses before a substep, on one thread."""
    if crew.thread == 0:
        write_poses(rigid, u, v, step)
    barrier(run.arrivals, crew.n_threads)


@kernel
def place_all_bodies(contact: Contact, run: NodeRun, u: Array, v: Array, step: int, crew: Crew) -> None:
    """Write the poses of the rigid bodies of a contact, if it has any."""
    place_bodies_each(contact.rigid, run, u, v, step, crew)


place_bodies_each = for_each(place_bodies)
place_all_bodies_each = for_each(place_all_bodies)


@kernel
def pass_on(rigid: Rigid, bars: NodeBars, u: Array, v: Array, b: int, step: int, pose_bar: Array) -> None:
    """Add the cotangent of a pose (B, 12) to that of a body's rows, or to that of the table."""
    r = rigid.row[b]
    if r < 0:
        at = min(rigid.begin[b] + step, rigid.begin[b + 1] - 1)
        for d in range(12):
            rigid.bars.table[at, d] += pose_bar[b, d]
        return
    number, bar = rigid.number, rigid.bars.number
    m, w_bar = number[b, MASS], entries(pose_bar, b, 9)
    theta_bar, L_bar, inertia_bar = angular_velocity_vjp(
        rigid.axes[b], entries(number, b, MOMENTS), quaternion_at(u, r), entries(v, r + 1, 0), w_bar
    )
    for d in range(3):
        bars.u[r, d] += pose_bar[b, d]
        bars.u[r + 1, d] += pose_bar[b, 3 + d] + theta_bar[d]
        bars.v[r, d] += pose_bar[b, 6 + d] / m
        bar[b, MASS] -= pose_bar[b, 6 + d] * v[r, d] / m**2
        bars.v[r + 1, d] += L_bar[d]
        bar[b, MOMENTS + d] += inertia_bar[d]


# --- records ---------------------------------------------------------------------------------------------------------


@kernel
def note_poses(rigid: Rigid, contact: Contact, run: NodeRun, u: Array, v: Array, step: int, crew: Crew) -> None:
    """Record the poses after a control step, and note a free body that is inside another, on one thread."""
    if crew.thread == 0:
        control = step // run.setting.substeps
        write_poses(rigid, u, v, step)
        for b in range(len(rigid.row)):
            for d in range(rigid.pose.shape[1]):
                rigid.record[control, b, d] = rigid.pose[b, d]
            if rigid.row[b] >= 0 and rigid.met[0] < 0:
                other = inside_which(rigid, contact, b)
                if other != b:
                    rigid.met[0], rigid.met[1], rigid.met[2] = b, other, control
    barrier(run.arrivals, crew.n_threads)


@kernel
def inside_which(rigid: Rigid, contact: Contact, b: int) -> int:
    """Return the rigid body in which a point of a body's skin is; its own number for none, -1 if it is nowhere."""
    c = entries(rigid.pose, b, 0)
    if not dot(c, c) < NOWHERE:
        return -1
    for other in range(len(rigid.row)):
        if (
            other != b
            and to_surface(contact.obstacles, rigid.first + other, at_rest(rigid, other, c))[0] < rigid.radius[b]
        ):
            for k in range(rigid.skin_begin[b], rigid.skin_begin[b + 1]):
                x = add(c, turn(quaternion_of(rigid, b), row(rigid.skin_rest, k)))
                if depth_in(rigid, contact, other, x) > 0.0:
                    return other
    return b


@kernel
def depth_in(rigid: Rigid, contact: Contact, b: int, x: Any) -> float:
    """Return how deep a position is inside a body; outside, a bound."""
    return -to_surface(contact.obstacles, rigid.first + b, at_rest(rigid, b, x))[0]


@kernel
def note_poses_vjp(rigid: Rigid, run: NodeRun, bars: NodeBars, u: Array, v: Array, step: int, crew: Crew) -> None:
    """Run the adjoint of the record, on one thread."""
    if crew.thread == 0:
        bar = rigid.bars.record[step // run.setting.substeps]
        for b in range(len(rigid.row)):
            pass_on(rigid, bars, u, v, b, step, bar)
    barrier(run.arrivals, crew.n_threads)


@kernel
def note_all_poses(contact: Contact, run: NodeRun, u: Array, v: Array, step: int, crew: Crew) -> None:
    """Run `note_poses` for the rigid bodies of a contact, if it has any."""
    note_poses_each(contact.rigid, contact, run, u, v, step, crew)


@kernel
def note_all_poses_vjp(
    contact: Contact, run: NodeRun, bars: NodeBars, u: Array, v: Array, step: int, crew: Crew
) -> None:
    """Run `note_poses_vjp` for the rigid bodies of a contact, if it has any."""
    note_poses_each_vjp(contact.rigid, run, bars, u, v, step, crew)


note_poses_each, note_poses_each_vjp = for_each(note_poses), for_each(note_poses_vjp)
note_all_poses_each, note_all_poses_each_vjp = for_each(note_all_poses), for_each(note_all_poses_vjp)
