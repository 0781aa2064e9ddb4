"""What probably made a rollout fail: which part of a body has swollen or shrunk, and which actuator drives it there.

When a particle is lost, a few others have usually gone wild, too, and their values say nothing. The particles of an
actuator are many, so their median still tells in which direction it drives them.
"""

from __future__ import annotations

import numpy as np

from cqrun.engine.model import ActuatorModel, Model
from cqrun.plugin.contract import Array
from cqrun.state import State

MEDIAN, EXTREME = 1.05, 2.0
"""Volume ratios J from which an actuator is suspected to swell its particles: the median, and the largest. To squeeze
them: the inverse of the median, and of the least."""

FEWEST = 4
"""Particles that an actuator must have: the points of a cable say nothing about a volume."""

BEYOND = 1000.0
"""Volume ratio from which only this bound is told: material that has gone wild."""


def place_of(model: Model, particle: int) -> str:
    """Return the body of a particle, and the smallest of its groups that contains the particle, as text."""
    body = next(n for n, part in zip(model.body_names, model.layout.slices(), strict=True) if particle < part.stop)
    group = group_of(model, particle)
    return f"'{group}' of '{body}'" if group else f"'{body}'"


def group_of(model: Model, particle: int) -> str:
    """Return the name of the smallest group that contains a particle, or an empty text."""
    around = {name: members for (_, name), members in model.regions.items() if particle in members}
    return min(around, key=lambda name: len(around[name]), default="")


def driver_at(model: Model, particle: int, J: float, activation: Array) -> str:
    """Return a sentence about the actuator that swells or squeezes a particle to J; empty if there is none.

    Args:
        model: the model.
        particle: its index.
        J: its volume ratio.
        activation: of each actuator (A,).
    """
    for k, actuator in enumerate(model.actuators):
        drives = activation[k] != 0.0 and len(actuator.particles) >= FEWEST and particle in actuator.carriers
        if drives and not 1.0 / EXTREME <= J <= EXTREME:
            return _told(model, actuator, float(activation[k]), J > 1.0, J)
    return ""


def suspect(model: Model, state: State, activation: Array) -> str:
    """Return a sentence about what probably made a motion fail in some state; empty if nothing stands out.

    Args:
        model: the model.
        state: the particles when it failed; values may be infinite or NaN.
        activation: of each actuator (A,).
    """
    with np.errstate(all="ignore"):
        J = np.linalg.det(state.F)
    for k, actuator in enumerate(model.actuators):
        own = J[actuator.carriers]
        own = own[np.isfinite(own)]
        if activation[k] == 0.0 or len(own) < FEWEST:
            continue
        median, least, most = float(np.median(own)), float(own.min()), float(own.max())
        if median > MEDIAN and most > EXTREME:
            return _told(model, actuator, float(activation[k]), True, most)
        if median < 1.0 / MEDIAN and least < 1.0 / EXTREME:
            return _told(model, actuator, float(activation[k]), False, least)
    return _inverted(model, J)


def _told(model: Model, actuator: ActuatorModel, activation: float, swells: bool, J: float) -> str:
    ratio = f"more than {BEYOND:g}" if J > BEYOND else "less than 0" if J < 0 else f"{J:.3g}"
    return (
        f"the actuator '{actuator.name}' {'swells' if swells else 'squeezes'} {_driven(model, actuator)} to a volume "
        f"ratio J of {ratio} at an activation of {activation:.3g}: weaken it, or make the material there stiffer"
    )


def _driven(model: Model, actuator: ActuatorModel) -> str:
    """Return what an actuator drives: a whole body, a group, or some of its particles."""
    members = np.sort(actuator.carriers)
    slices = zip(model.body_names, model.layout.slices(), strict=True)
    body, part = next((name, part) for name, part in slices if members[0] < part.stop)
    if len(members) == part.stop - part.start:
        return f"'{body}'"
    for (owner, name), group in model.regions.items():
        if owner == body and np.array_equal(np.sort(group), members):
            return f"the group '{name}' of '{body}'"
    return f"its {len(members):,} particles of '{body}'"


def _inverted(model: Model, J: Array) -> str:
    """Return a sentence about the body or group with the most particles that are turned inside out, or nothing."""
    inside_out = np.isfinite(J) & (J <= 0.0)
    if not inside_out.any():
        return ""
    bodies = zip(model.body_names, model.layout.slices(), strict=True)
    places = {f"'{name}'": np.arange(part.start, part.stop) for name, part in bodies}
    body = max(places, key=lambda place: int(inside_out[places[place]].sum()))
    inner = {f"'{g}' of '{b}'": members for (b, g), members in model.regions.items() if f"'{b}'" == body}
    place = max(inner, key=lambda name: int(inside_out[inner[name]].sum()), default=body)
    members = (places | inner)[place]
    count = int(inside_out[members].sum())
    if not count:
        place, members, count = body, places[body], int(inside_out[places[body]].sum())
    return (
        f"{count:,} of the {len(members):,} particles of {place} are turned inside out (J < 0): load it less or more "
        "slowly, or use a law that resists it (`neo_hookean`)"
    )
