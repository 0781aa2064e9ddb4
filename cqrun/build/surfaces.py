"""The surfaces of bodies at rest as points and facets, found once from the test whether a point is inside a body."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from cqrun.build.particles import Particles
from cqrun.build.regions import BodyPoints
from cqrun.forces.force import Skin
from cqrun.geometry.place import Place
from cqrun.geometry.shape import finite_bounds
from cqrun.geometry.skin import make_skin
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

PER_CELL = 2
"""Points of a surface in a cell, along each direction of the surface."""


class BodySurface(NamedTuple):
    """The surfaces of all bodies at rest, in the order of the particles' bodies.

    Attributes:
        x, local: points (S, D) [m] in the world, and in their body's own coordinates (`place`).
        area: of each point (S,) [m^(D-1)].
        particle: nearest particle of the same body, in user order (S,).
        facets: (T, D) the points of each segment or triangle.
        begin: (B + 1,) where the points of a body begin.
    """

    x: Array
    local: Array
    area: Array
    particle: Array
    facets: Array
    begin: Array


def touches(scene: Scene) -> bool:
    """Return whether bodies can touch something."""
    obstacles = scene.world.frame == "reference" and any(is_obstacle(scene, name) for name in scene.boundaries)
    return obstacles or scene.bodies_meet or (scene.world.frame == "reference" and bool(scene.rigid))


def is_obstacle(scene: Scene, name: str) -> bool:
    """Return whether a boundary is one that bodies of the reference frame touch."""
    spec: Any = scene.boundaries[name].value
    return bool(spec.is_obstacle)


def surface_of(scene: Scene, particles: Particles) -> BodySurface:
    """Return the surfaces of all bodies; they are found once."""
    known: BodySurface | None = particles.found.get("surface")
    if known is None:
        known = particles.found["surface"] = _find_surface(scene, particles)
    return known


def skin_of(scene: Scene, particles: Particles, name: str) -> Skin:
    """Return the surface of one body."""
    surface, k = surface_of(scene, particles), list(particles.names).index(name)
    begin, end = surface.begin[k], surface.begin[k + 1]
    facets = surface.facets[(surface.facets[:, 0] >= begin) & (surface.facets[:, 0] < end)]
    first, own, place = particles.of(name).start, particles.points[name], scene.bodies[name].place or Place()

    def pick(region: Any, x: Array, particle: Array) -> Array:
        local = place.to_local(x)
        return BodyPoints(scene, name, x, x, local, own.piece[particle - first]).pick(region)

    return Skin(surface.x[begin:end], surface.particle[begin:end], facets - begin, pick)


def _find_surface(scene: Scene, particles: Particles) -> BodySurface:
    x, local, area, particle, facets, begin = [], [], [], [], [], [0]
    for name in particles.names:
        body, part = scene.bodies[name], particles.of(name)
        place, pieces = body.place or Place(), list(body.pieces.values())

        def inside(points: Array, pieces: list[Any] = pieces) -> Array:
            return np.any([piece.inside(points) for piece in pieces], axis=0)

        bounds = [finite_bounds(piece) for piece in pieces]
        lower, upper = np.min([low for low, _ in bounds], axis=0), np.max([high for _, high in bounds], axis=0)
        known = len(pieces) == 1 and pieces[0].distance(lower[None]) is not None
        distance: Any = pieces[0].distance if known else None
        skin = make_skin(inside, lower, upper, scene.world.dx / PER_CELL / place.scale, distance)
        local.append(skin.x)
        x.append(skin.x if body.place is None else place.to_world(skin.x))
        area.append(skin.area * place.scale ** (scene.dim - 1))
        particle.append(part.start + cKDTree(particles.x[part]).query(x[-1])[1])
        facets.append(skin.facets + begin[-1])
        begin.append(begin[-1] + len(skin.x))
    each = (np.concatenate(parts) for parts in (x, local, area, particle, facets))
    return BodySurface._make((*each, np.array(begin)))
