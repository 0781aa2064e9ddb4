"""The arguments of the kernels of rigid bodies: poses, what acts on them, their skins, and cotangents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.model import Inputs, Model
from cqrun.engine.reference.contact import Obstacles, Pushes
from cqrun.engine.reference.poses import (
    POSE,
    POSE_BAR,
    left_jacobian,
    own_waypoints,
    rotation_vector,
    start_rows,
    start_rows_vjp,
    table_of,
    table_of_vjp,
)
from cqrun.engine.reference.rub import ONSET
from cqrun.engine.rigid_model import NUMBERS, OFFSET, ROWS, count_skin
from cqrun.errors import RigidBodyError
from cqrun.numerics.compile import own_symbols
from cqrun.plugin.contract import Array


class SkinConstants(NamedTuple):
    """Of the points on the skins of free bodies; see `contact.Surface`."""

    stiffness: Array  # (K,)
    impedance: Array
    onset: float


class Skin(NamedTuple):
    """Points on the skins of free bodies, which touch the obstacles of boundaries; it serves as a `Contact`."""

    surface: SkinConstants
    obstacles: Obstacles  # of boundaries alone
    rigid: tuple[Any, ...]  # none
    pushes: tuple[Pushes, ...]
    friction_bar: Array  # (K, O)
    first: int  # number of its first spring
    force: Array  # (K, 6) force and moment on each point's body
    pose_bar: Array  # (K, 12)


class RigidBars(NamedTuple):
    """Cotangents of rigid bodies, and arrays in which the adjoint of a substep works."""

    acting: Array  # (B, 6) of force and moment on each body
    pose: Array  # (S, B, 12) of poses, from each point of soft surfaces
    total: Array  # (B, 12) the sums of these
    table: Array  # (rows, 12) of the poses of paths
    number: Array  # (B, 20) of `Rigid.number`
    record: Array  # (T + 1, B, 12) of the recorded poses


class Rigid(NamedTuple):
    """Rigid bodies. They are obstacles after those of boundaries."""

    first: int  # number of the first among the obstacles
    row: Array  # (B,) row of a state where a free body's begin, else -1
    center: Array  # (B, 3) at rest [m]
    radius: Array  # (B,) [m]
    axes: Array  # (B, 3, 3) rows are the principal axes at rest
    number: Array  # (B, 20) as in `Inputs.rigid`
    table: Array  # (rows, 13) poses of the others after each substep
    begin: Array  # (B + 1,) where the poses of a body begin
    pose: Array  # (B, 13) in this substep
    mark: Array  # (B, 13) when points near obstacles were found
    skin_rest: Array  # (K, 3) points on the skins of free bodies, from their centre at rest [m]
    skin_begin: Array  # (B + 1,) where those of a body begin
    force: Array  # (S, B, 6) force and moment of each body on each point
    total: Array  # (B, 6) those on each body
    skin: tuple[Skin, ...]  # one entry, or none
    record: Array  # (T + 1, B, 13) poses at control steps
    met: Array  # (3,) a body that is where it must not be, the one that it is inside, or -1, and the control step
    bars: RigidBars


for _class in (SkinConstants, Skin, RigidBars, Rigid):
    own_symbols(_class)


def make_rigid(
    model: Model, inputs: Inputs, obstacles: Obstacles, pushes: tuple[Pushes, ...], n_points: int, n_nodes: int
) -> tuple[Rigid, ...]:
    """Return one entry, or none if there are no rigid bodies.

    Args:
        obstacles, pushes: of boundaries alone, for the skins of free bodies.
        n_points: of all soft surfaces.
        n_nodes: of a state.
    """
    bodies, count = model.rigid, len(model.rigid)
    if not bodies:
        return ()
    number, free = np.array(inputs.rigid, np.float64), np.array([body.free for body in bodies])
    tables = tables_of(model, inputs)
    row = np.where(free, n_nodes + -(-model.n_springs // 2) + ROWS * (np.cumsum(free) - 1), -1)
    center, radius, axes = (np.array([getattr(body, name) for body in bodies]) for name in ("center", "radius", "axes"))
    return (
        Rigid(
            len(model.obstacles), row, center, radius, axes, number, np.concatenate(tables),
            np.cumsum([0, *map(len, tables)]).astype(np.int64), np.zeros((count, POSE)), np.zeros((count, POSE)),
            np.concatenate([body.skin - body.center for body in bodies]),
            np.cumsum([0, *(len(body.skin) for body in bodies)]).astype(np.int64), np.zeros((n_points, count, 6)),
            np.zeros((count, 6)), make_skin(model, obstacles, pushes),
            np.zeros((model.n_controls + 1, count, POSE)), np.full(3, -1),
            zero_bars(model, n_points, sum(map(len, tables))),
        ),
    )  # fmt: skip


def tables_of(model: Model, inputs: Inputs) -> list[Array]:
    """Return the poses (T + 1, 13) of each body after each substep: a single one if it stays, none if it is free."""
    waypoints = np.array(inputs.waypoints, np.float64).reshape(-1, 6)
    return [
        np.zeros((0, POSE)) if body.free else table_of(body, number, waypoints[at], moments(model))
        for body, number, at in zip(model.rigid, np.array(inputs.rigid, float), own_waypoints(model.rigid), strict=True)
    ]


def moments(model: Model) -> Array:
    """Return the time after each substep (T + 1,) [s]."""
    return np.arange(model.n_steps + 1) * model.dt


def make_skin(model: Model, obstacles: Obstacles, pushes: tuple[Pushes, ...]) -> tuple[Skin, ...]:
    """Return one entry, or none if no free body can touch a boundary."""
    bodies, n = model.rigid, count_skin(model.rigid)
    if not n or not model.obstacles:
        return ()
    constants = (np.concatenate([getattr(body, name) for body in bodies]) for name in ("stiffness", "impedance"))
    return (
        Skin(
            SkinConstants(*constants, ONSET * model.dx), obstacles, (), pushes, np.zeros((n, len(model.obstacles))),
            model.first_skin_spring, np.zeros((n, 6)), np.zeros((n, POSE_BAR)),
        ),
    )  # fmt: skip


def zero_bars(model: Model, n_points: int, n_poses: int) -> RigidBars:
    """Return zero cotangents for surfaces of `n_points`, and tables of `n_poses`."""
    count = len(model.rigid)
    return RigidBars(
        np.zeros((count, 6)), np.zeros((n_points, count, POSE_BAR)), np.zeros((count, POSE_BAR)),
        np.zeros((n_poses, POSE_BAR)), np.zeros((count, NUMBERS)), np.zeros((model.n_controls + 1, count, POSE_BAR)),
    )  # fmt: skip


def with_own_bars(rigid: Rigid, model: Model, mean_bar: Array) -> Rigid:
    """Return rigid bodies with zero cotangents of their own, and those of reactions (T, B, 6)."""
    skin = tuple(
        each._replace(
            friction_bar=np.zeros_like(each.friction_bar),
            pushes=tuple(pushes._replace(mean_bar=mean_bar) for pushes in each.pushes),
        )
        for each in rigid.skin
    )
    return rigid._replace(skin=skin, bars=zero_bars(model, len(rigid.force), len(rigid.table)))


# --- a rollout -------------------------------------------------------------------------------------------------------


def put_start(rigid: Rigid, model: Model, start: Array) -> None:
    """Write the rows of free bodies to the state at the start (2, rows, 4)."""
    for b, body in enumerate(model.rigid):
        if body.free:
            at = slice(rigid.row[b], rigid.row[b] + ROWS)
            start[0, at], start[1, at] = start_rows(body, rigid.number[b])


def start_bars(rigid: Rigid, model: Model, waypoints: Array, q_bar: Array) -> tuple[Array, Array]:
    """Return the cotangents of `Inputs.rigid` and `Inputs.waypoints` from that of the state at the start."""
    out, waypoints_bar = rigid.bars.number.copy(), np.zeros(waypoints.shape)
    places = own_waypoints(model.rigid)
    for b, body in enumerate(model.rigid):
        if body.free:
            at = slice(rigid.row[b], rigid.row[b] + ROWS)
            out[b] += start_rows_vjp(body, rigid.number[b], q_bar[0, at], q_bar[1, at])
        else:
            bar = rigid.bars.table[rigid.begin[b] : rigid.begin[b + 1]]
            offset_bar, waypoints_bar[places[b]] = table_of_vjp(body, waypoints[places[b]], moments(model), bar)
            out[b, OFFSET] += offset_bar
    return out, waypoints_bar


def rows_of_bodies(rigid: tuple[Rigid, ...]) -> int:
    """Return how many rows of a state have free bodies."""
    return sum(ROWS * int((each.row >= 0).sum()) for each in rigid)


# --- what is recorded ------------------------------------------------------------------------------------------------


def poses_by_name(rigid: tuple[Rigid, ...], model: Model, at: Any = slice(None)) -> dict[str, Array]:
    """Return what users see of every rigid body (T + 1, 6 or 12), by name, or at one time; see `pose_columns`."""
    return {
        body.name: seen_poses(each.record[at, b], each.center[b], model.dim)
        for each in rigid
        for b, body in enumerate(model.rigid)
    }


def seen_poses(record: Array, center: Array, dim: int) -> Array:
    """Return what users see of recorded poses (..., 13): (..., 6 or 12), see `pose_columns`."""
    full = np.concatenate([record[..., :3] - center, rotation_vector(record[..., 3:7]), record[..., 7:]], axis=-1)
    return full[..., pose_columns(dim)]


def pose_columns(dim: int) -> list[int]:
    """Return which of displacement, rotation vector, velocity and angular velocity (12) a world has."""
    return [0, 1, 5, 6, 7, 11] if dim == 2 else list(range(12))


def seen_poses_vjp(record: Array, dim: int, bar: Array) -> Array:
    """Return the cotangent (..., 12) of recorded poses (..., 13) from that of `seen_poses`."""
    out = np.zeros((*record.shape[:-1], POSE_BAR))
    out[..., pose_columns(dim)] = bar
    out[..., 3:6] = np.einsum("...ji,...j->...i", inverse_jacobian(rotation_vector(record[..., 3:7])), out[..., 3:6])
    return out


def add_record_bars(rigid: Rigid, model: Model, bars: Mapping[str, Array], at: Any = slice(None)) -> None:
    """Add the cotangents of records (T + 1, 6 or 12), or of those at one time, by name, to those of the poses."""
    for b, body in enumerate(model.rigid):
        if body.name in bars:
            rigid.bars.record[at, b] += seen_poses_vjp(rigid.record[at, b], model.dim, bars[body.name])


def meeting_error(rigid: Rigid, model: Model) -> RigidBodyError:
    """Return the error of a free body that is inside another rigid body, or nowhere."""
    b, other, control = rigid.met
    name, time = model.rigid[b].name, control * model.substeps * model.dt
    if other < 0:
        return RigidBodyError("its position is not finite", rigid=name, time=time, advice="use a shorter substep")
    return RigidBodyError(
        f"it is inside the rigid body '{model.rigid[other].name}', and rigid bodies do not feel each other", rigid=name,
        time=time, advice="keep them apart, or make one of them a soft body",
    )  # fmt: skip


def inverse_jacobian(theta: Array) -> Array:
    """Return the derivative of rotation vectors by small rotations in the world (..., 3, 3)."""
    return np.asarray(np.linalg.inv(left_jacobian(theta)))
