"""All of contact in a substep, with obstacles and between bodies, and its adjoint."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cqrun.engine.model import Inputs, Model
from cqrun.engine.reference.contact import Contact, make_contact, make_surface
from cqrun.engine.reference.meet import encounter_each, encounter_each_vjp, encounter_rates_each_vjp
from cqrun.engine.reference.meeting import Meeting, make_meeting
from cqrun.engine.reference.movers import zero_bars
from cqrun.engine.reference.points import riding_points_vjp
from cqrun.engine.reference.rest import RestGeometry
from cqrun.engine.reference.setting import NodeBars, NodeRun, NodeStep
from cqrun.engine.reference.touch import touch_each, touch_each_vjp, touch_rates_each_vjp
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
    surface, coefficients = make_surface(model, rest, inputs.surface), inputs.coefficients
    return Contacts(
        make_contact(model, surface, coefficients, n_threads), make_meeting(model, surface, coefficients, n_threads)
    )


def with_own_bars(contacts: Contacts, inputs: Inputs, mean_bar: Array) -> Contacts:
    """Return contacts with cotangents of friction and of the points at rest of their own, zero.

    `mean_bar` (T, B, 6) has the cotangents of the reactions.
    """

    def renewed(each: Any) -> Any:
        bars = zero_bars(each.surface.points, inputs.shaped)
        return each._replace(friction_bar=np.zeros_like(each.friction_bar), bars=bars)

    def pushed(each: Any) -> Any:
        return each._replace(pushes=tuple(pushes._replace(mean_bar=mean_bar) for pushes in each.pushes))

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
    for meeting in contacts.bodies:
        coefficient_bar[len(model.conditions)] += meeting.friction_bar.sum()


def clear_slid(contacts: Contacts) -> None:
    """Forget whether forces depended on velocities or springs."""
    for kind in contacts:
        for each in kind:
            each.slid[:] = 0


def has_slid(contacts: Contacts) -> bool:
    """Return whether a force depended on a velocity or a spring, so that a run cannot be reversed."""
    return any(each.slid.any() for kind in contacts for each in kind)


@kernel
def touch_all(contacts: Contacts, run: NodeRun, at: NodeStep, u_next: Array, keep: bool, crew: Crew) -> None:
    """Add the forces of contact to `run.force`, and write the springs after the substep."""
    touch_each(contacts.obstacles, run, at, u_next, keep, crew)
    encounter_each(contacts.bodies, run, at, u_next, keep, crew)


@kernel
def touch_all_vjp(contacts: Contacts, run: NodeRun, bars: NodeBars, at: NodeStep, reversed_: bool, crew: Crew) -> None:
    """Run the adjoint but for the cotangents of velocities; see `touch_vjp`."""
    touch_each_vjp(contacts.obstacles, run, bars, at, reversed_, crew)
    encounter_each_vjp(contacts.bodies, run, bars, at, reversed_, crew)


@kernel
def touch_rates_all_vjp(contacts: Any, run: NodeRun, bars: NodeBars, crew: Crew) -> None:
    """Add the cotangents of velocities, which `touch_all_vjp` has found."""
    touch_rates_each_vjp(contacts.obstacles, run, bars, crew)
    encounter_rates_each_vjp(contacts.bodies, run, bars, crew)
