"""Rigid bodies, as parts of the model: what they are made of, and how they move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cqrun.boundaries.solid import Solid
from cqrun.plugin.contract import Array

OFFSET, VELOCITY, SPIN, MASS, INERTIA, FORCE, TORQUE, FRICTION = (
    slice(0, 3), slice(3, 6), slice(6, 9), 9, slice(10, 13), slice(13, 16), slice(16, 19), 19,
)  # fmt: skip
"""Columns of `Inputs.rigid`: the offset of the shape [m], velocity and spin at the start, mass, the moments of inertia
about `RigidModel.axes`, the constant force and torque (with gravity), and the coefficient of friction."""

NUMBERS = 20
"""Their number."""

ROWS = 2
"""Rows of a state that a free body has."""


@dataclass(frozen=True)
class RigidModel:
    """A rigid body; vectors have 3 entries, also in 2D.

    Attributes:
        name: as in the scene.
        solids: its shape at rest, whose union it is.
        center: of mass at rest, about which it turns (3,) [m].
        radius: of a ball about the centre that contains it [m]; of one that contains the world for an infinite shape.
        rubs: whether it has friction.
        dashpot: of contact along the normal, as a part of the impedance.
        free: whether forces move it.
        times: of the waypoints of its path (W,) [s], increasing; those of all bodies follow each other in
            `Inputs.waypoints`. Without any it stays where it is, unless it is free.
        axes: rows are the principal axes of inertia at rest (3, 3), with increasing moments.
        skin: points of the surface of a free body at rest (K, 3) [m].
        stiffness, impedance: of these points (K,), as those of `SurfaceModel`.
    """

    name: str
    solids: tuple[Solid, ...]
    center: Array
    radius: float
    rubs: bool = False
    dashpot: float = 0.0
    free: bool = False
    times: Array = field(default_factory=lambda: np.zeros(0))
    axes: Array = field(default_factory=lambda: np.eye(3))
    skin: Array = field(default_factory=lambda: np.zeros((0, 3)))
    stiffness: Array = field(default_factory=lambda: np.zeros(0))
    impedance: Array = field(default_factory=lambda: np.zeros(0))


def count_free(bodies: Sequence[RigidModel]) -> int:
    """Return how many bodies move freely."""
    return sum(body.free for body in bodies)


def count_skin(bodies: Sequence[RigidModel]) -> int:
    """Return the number of points on the skins of free bodies."""
    return sum(len(body.skin) for body in bodies)
