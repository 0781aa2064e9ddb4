"""All of contact in a substep, with obstacles and between bodies, and its adjoint."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.model import Inputs, Model
from cqrun.engine.reference.contact import Contact, make_contact, make_obstacles, make_pushes, make_surface
from cqrun.engine.reference.meet import encounter_each, encounter_each_vjp, encounter_rates_each_vjp
from cqrun.engine.reference.meeting import Meeting, make_meeting
from cqrun.engine.reference.movers import zero_bars
from cqrun.engine.reference.placing import place_all_bodies_each
from cqrun.engine.reference.points import riding_points_vjp
from cqrun.engine.reference.rest import RestGeometry
from cqrun.engine.reference.ride import ride_all_each, ride_all_each_vjp, settle_all_poses_each
from cqrun.engine.reference.rigid import Rigid, make_rigid, start_bars
from cqrun.engine.reference.rigid import with_own_bars as with_own_rigid_bars
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep
from cqrun.engine.reference.touch import touch_each, touch_each_vjp, touch_rates_each_vjp
from cqrun.engine.rigid_model import FRICTION, count_skin
from cqrun.engine.setting import Crew
from cqrun.numerics.compile import kernel, own_symbols
from cqrun.plugin.contract import Array


class Contacts(NamedTuple):
    """What bodies touch: each has one entry, or none if there is nothing of its kind."""

    obstacles: tuple[Contact, ...]
    bodies: tuple[Meeting, ...]


own_symbols(Contacts)


def make_contacts(model: Model, rest: RestGeometry, inputs: Inputs, n_threads: int) -> Contacts:
    """Return the kernels' view of all contact of a model."""
    if model.surface is None:
        return Contacts((), ())
    surface, fixed = make_surface(model, rest, inputs.surface), make_obstacles(model, inputs, rigid=False)
    pushes = make_pushes(model, count_skin(model.rigid), rigid=False)
    rigid = make_rigid(model, inputs, fixed, pushes, len(surface.rest), rest.patches.n_nodes)
    obstacles = make_obstacles(model, inputs, rigid=True)
    return Contacts(
        make_contact(model, surface, obstacles, rigid, n_threads),
        make_meeting(model, surface, inputs.coefficients, n_threads),
    )


def rigid_of(contacts: Contacts) -> tuple[Rigid, ...]:
    """Return the rigid bodies of all contact: one entry, or none."""
    return tuple(rigid for contact in contacts.obstacles for rigid in contact.rigid)


def with_own_bars(contacts: Contacts, model: Model, inputs: Inputs, mean_bar: Array) -> Contacts:
    """Return contacts with cotangents of friction and of the points at rest of their own, zero.

    `mean_bar` (T, B, 6) has the cotangents of the reactions.
    """

    def renewed(each: Any) -> Any:
        bars = zero_bars(each.surface.points, inputs.shaped)
        return each._replace(friction_bar=np.zeros_like(each.friction_bar), bars=bars)

    def pushed(each: Any) -> Any:
        rigid = tuple(with_own_rigid_bars(bodies, model, mean_bar) for bodies in each.rigid)
        return each._replace(pushes=tuple(p._replace(mean_bar=mean_bar) for p in each.pushes), rigid=rigid)

    obstacles = tuple(pushed(renewed(each)) for each in contacts.obstacles)
    return Contacts(obstacles, tuple(renewed(each) for each in contacts.bodies))


def rest_bars(contacts: Contacts, rollout: Any) -> tuple[Array, Array]:
    """Return the cotangents of the surface's points (S, D) and of the particles (N, D) at rest, of contact alone."""
    model, rest, surface = rollout.model, rollout.rest, rollout.model.surface
    if surface is None:
        return np.zeros((0, model.dim)), np.zeros(rest.x.shape)
    surface_bar, x_bar = np.zeros(surface.x.shape), np.zeros(rest.x.shape)
    for each in (*contacts.obstacles, *contacts.bodies):
        if rollout.inputs.shaped:
            x = each.surface.rest[:, : model.dim]
            found = riding_points_vjp(rest.patches, rest.x, surface.particle, x, model.dx, each.bars.weight)
            surface_bar += found[0] + each.bars.rest[:, : model.dim]
            x_bar += found[1]
    return surface_bar, x_bar


def add_friction_bars(contacts: Contacts, model: Model, coefficient_bar: Array) -> None:
    """Add the cotangents of friction, which are summed point by point, to those of the coefficients."""
    for contact in contacts.obstacles:
        for k, obstacle in enumerate(model.obstacles):
            coefficient_bar[obstacle.condition] += contact.friction_bar[:, k].sum()
            for skin in (skin for rigid in contact.rigid for skin in rigid.skin):
                coefficient_bar[obstacle.condition] += skin.friction_bar[:, k].sum()
    for meeting in contacts.bodies:
        coefficient_bar[len(model.conditions)] += meeting.friction_bar.sum()


def add_rigid_bars(contacts: Contacts, model: Model, inputs: Inputs, q_bar: Array, bar: Inputs) -> None:
    """Add the cotangents of rigid bodies to those of the inputs, from that of the state at the start."""
    for contact in contacts.obstacles:
        for rigid in contact.rigid:
            number_bar, waypoints_bar = start_bars(rigid, model, inputs.waypoints, q_bar)
            number_bar[:, FRICTION] += contact.friction_bar[:, len(model.obstacles) :].sum(axis=0)
            bar.rigid += number_bar
            bar.waypoints += waypoints_bar


def clear_slid(contacts: Contacts) -> None:
    """Forget whether forces depended on velocities or springs."""
    for kind in contacts:
        for each in kind:
            each.slid[:] = 0


def has_slid(contacts: Contacts) -> bool:
    """Return whether a force depended on a velocity or a spring, so that a run cannot be reversed."""
    return any(each.slid.any() for kind in contacts for each in kind)


@kernel
def touch_all(contacts: Contacts, run: NodeRun, at: NodeStep, u_next: Array, step: int, keep: bool, crew: Crew) -> None:
    """Add the forces of contact to `run.force`, write the springs after the substep, and move rigid bodies."""
    place_all_bodies_each(contacts.obstacles, run, at.u, at.v, step, crew)
    touch_each(contacts.obstacles, run, at, u_next, keep, crew)
    encounter_each(contacts.bodies, run, at, u_next, keep, crew)
    ride_all_each(contacts.obstacles, run, at, u_next, crew)


@kernel
def touch_all_vjp(
    contacts: Contacts, run: NodeRun, bars: NodeBars, at: NodeStep, step: int, reversed_: bool, crew: Crew
) -> None:
    """Run the adjoint but for the cotangents of velocities; see `touch_vjp`."""
    place_all_bodies_each(contacts.obstacles, run, at.u, at.v, step, crew)
    ride_all_each_vjp(contacts.obstacles, run, bars, at, crew)
    touch_each_vjp(contacts.obstacles, run, bars, at, reversed_, crew)
    encounter_each_vjp(contacts.bodies, run, bars, at, reversed_, crew)
    settle_all_poses_each(contacts.obstacles, run, bars, at, step, crew)


@kernel
def touch_rates_all_vjp(contacts: Any, run: NodeRun, bars: NodeBars, crew: Crew) -> None:
    """Add the cotangents of velocities, which `touch_all_vjp` has found."""
    touch_rates_each_vjp(contacts.obstacles, run, bars, crew)
    encounter_rates_each_vjp(contacts.bodies, run, bars, crew)
