"""Routes of cables and springs: how far their points lie from what they pull, and where their lines leave the body."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cqrun.build.actuation import Part
from cqrun.build.hosts import contains
from cqrun.build.particles import Particles
from cqrun.errors import Problem
from cqrun.forces.routed import Routed, Way
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import body_of
from cqrun.scene.paths import canonical, shapes_a_body
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import body_of as body_of_path

FAR = 1.0
"""Distance of a point from its particle [spacings] from which there is a warning. A point inside a body or on its
surface is at most sqrt(D) / 2 spacings from a particle of a lattice: 0.71 in 2D, 0.87 in 3D."""

MILLI = 1e3


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
        return f"{MILLI * self.distance:.3g} mm ({self.distance / self.spacing:.2g} spacings)"


def tied(particles: Particles, part: Part) -> Tied | None:
    """Return which point of a part's route is farthest from its particle; None if it is not tied to particles."""
    body, given = body_of(part.spec), _given(part)
    if given is None or body is None or part.exact:
        return None
    x = particles.x[part.model.particles]
    gaps = np.linalg.norm(given[:, None] - x[None], axis=2)
    number = int(np.argmax(gaps.min(axis=1)))
    nearest = int(np.argmin(gaps[number]))
    return Tied(number, float(gaps[number, nearest]), particles.spacing[body], x[nearest])


def _given(part: Part) -> Array | None:
    """Return the points of a part's routes (n, D) [m]; None for a part without a route."""
    if isinstance(part.spec, Routed):
        return np.concatenate([way.points for way in part.spec.ways()])
    route = getattr(part.spec, "route", None)
    return np.array(route) if route else None


def spool_problems(scene: Scene) -> list[Problem]:
    """Return an error for each spool that sets the lengths of several cables in a body whose shape is unknown.

    What the lengths at rest have to do with each other would have to follow the shape (`actuators/tendon.py`).
    """
    shaped = {path: body_of_path(scene, p) for path in scene.unknowns if shapes_a_body(p := canonical(scene, path))}
    spools = {
        f"actuators.{name}.{chosen.name}": spec
        for name, chosen in scene.actuators.items()
        if getattr(spec := chosen.value, "routes", None) and getattr(spec, "stiffness", None) is not None
    }
    message = "sets the lengths of several cables in '{}', so the shape of '{}' cannot be unknown: give `tension`"
    return [
        Problem(scene.where(f"unknowns.{path}"), f"unknowns.{path}", f"{where} " + message.format(body, body))
        for path, body in shaped.items()
        for where, spec in spools.items()
        if body_of(spec) == body
    ]


def route_warnings(scene: Scene, particles: Particles, parts: Sequence[Part]) -> Iterator[Problem]:
    """Yield a warning for each route with a point far from its particle, or a line that leaves its body."""
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
        if part.exact and isinstance(part.spec, Routed) and not getattr(part.spec, "free", False):
            yield from _lines_outside(scene, particles, part, part.spec.ways())


def _lines_outside(scene: Scene, particles: Particles, part: Part, ways: Sequence[Way]) -> Iterator[Problem]:
    """Yield a warning for the first line of each route that leaves the body between its points."""
    body = body_of(part.spec)
    assert body is not None
    inside = contains(scene, particles, body)
    for way in ways:
        for begin, end in itertools.pairwise(way.points):
            pieces = max(2, int(np.ceil(np.linalg.norm(end - begin) / particles.spacing[body])))
            between = begin + (end - begin) * (np.arange(1, pieces) / pieces)[:, None]
            outside = between[~inside(between)]
            if len(outside):
                at = ", ".join(f"{c + 0.0:.4g}" for c in outside[len(outside) // 2])
                message = (
                    f"a straight line of its route leaves the body '{body}', at ({at}) m for one: nothing guides it "
                    "there; if that is meant, say `free: true`"
                )
                yield Problem(scene.where(part.path), part.path, message)
                break
