"""How far the points of a route lie from the particles that a cable or a spring is tied to."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cqrun.build.actuation import Part
from cqrun.build.particles import Particles
from cqrun.errors import Problem
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import body_of
from cqrun.scene.schema import Scene

FAR = 1.0
"""Distance of a point from its particle [spacings] from which there is a warning. A point inside a body or on its
surface is at most sqrt(D) / 2 spacings from a particle of a lattice: 0.71 in 2D, 0.87 in 3D."""


class Tied(NamedTuple):
    """The point of a route that is farthest from the particle it is tied to.

    Attributes:
        number: of the point in the route.
        distance: between the point and the particle at rest [m].
        spacing: of the body's particles [m].
        particle: its position at rest (D,) [m].
    """

    number: int
    distance: float
    spacing: float
    particle: Array

    def __str__(self) -> str:
        """Return the distance in words."""
        return f"{self.distance:.3g} m ({self.distance / self.spacing:.2g} spacings)"


def tied(particles: Particles, part: Part) -> Tied | None:
    """Return which point of a part's route is farthest from its particle; None for a part without a route."""
    route = getattr(part.spec, "route", None)
    body = body_of(part.spec)
    if not route or body is None:
        return None
    x = particles.x[part.model.particles]
    gaps = np.linalg.norm(np.array(route)[:, None] - x[None], axis=2)
    number = int(np.argmax(gaps.min(axis=1)))
    nearest = int(np.argmin(gaps[number]))
    return Tied(number, float(gaps[number, nearest]), particles.spacing[body], x[nearest])


def route_warnings(scene: Scene, particles: Particles, parts: Sequence[Part]) -> Iterator[Problem]:
    """Yield a warning for each route with a point outside its body, or in a gap of it."""
    for part in parts:
        found = tied(particles, part)
        if found is not None and found.distance > FAR * found.spacing:
            path = f"{part.path}.route.{found.number}"
            at = ", ".join(f"{c + 0.0:.4g}" for c in found.particle)
            message = (
                f"is {found} from the nearest particle, at ({at}) m, to which it is tied: the pull acts there, with "
                "that lever arm; move the point into the body, or use more particles per cell"
            )
            yield Problem(scene.where(path), path, message)
