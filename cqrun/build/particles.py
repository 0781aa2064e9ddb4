"""The particles of a scene's bodies, sampled once at rest."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cqrun.build.check_gaps import bodies_too_close
from cqrun.build.check_memory import require_memory
from cqrun.build.check_particles import (
    file_problems,
    geometry_problems,
    planes_between_nodes,
    sparse_bodies,
    volume_errors,
    walls_outside,
)
from cqrun.build.check_units import bodies_of_another_size
from cqrun.build.history import history_of
from cqrun.build.regions import BodyPoints
from cqrun.engine.blocks import BLOCK
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.geometry.place import Place
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene
from cqrun.state import Layout


@dataclass(frozen=True)
class Particles:
    """All particles of a scene, body after body in the order of `names`.

    Attributes:
        names: names of the bodies; bodies with the same stress terms are next to each other.
        layout: number of particles of each body.
        points: the particles of each body, in the form that regions use.
        x: positions at rest (N, D) [m].
        volume: volumes at rest (N,) [m^D]; 1 if the body has `unit_mass`.
        room: the space that each particle fills at rest, divided by its `volume` (N,): 1, or [m^D] if the body has
            `unit_mass`.
        spacing: distance between the particles of each body [m].
        warnings: what a user should know.
        found: what was found from the particles, and is expensive to find again.
    """

    names: tuple[str, ...]
    layout: Layout
    points: dict[str, BodyPoints]
    x: Array
    volume: Array
    room: Array
    spacing: dict[str, float]
    warnings: tuple[Problem, ...]
    found: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def of(self, body: str) -> slice:
        """Return the slice of a body's particles."""
        return self.layout.slices()[self.names.index(body)]

    def inside(self, body: str | None, region: Any) -> Array:
        """Return the indices of the particles of a body, or of all bodies, in a region, a named one, or everywhere."""
        bodies = self.names if body is None else (body,)
        picked = [self.of(name).start + np.flatnonzero(self.points[name].pick(region)) for name in bodies]
        return np.concatenate(picked)

    def groups(self, body: str) -> dict[str, Array]:
        """Return the particle indices of each group of a body, by name."""
        start = self.of(body).start
        return {name: start + np.flatnonzero(inside) for name, inside in self.points[body].groups.items()}

    def labels(self, body: str) -> Array:
        """Return the group number of each particle of a body (N_b,): the last group that contains it, or -1."""
        points = self.points[body]
        labels = np.full(len(points.x), -1)
        for k, inside in enumerate(points.groups.values()):
            labels[inside] = k
        return labels


def stress_key(scene: Scene, body: str) -> tuple[Any, ...]:
    """Return a key that is equal for bodies with the same stress terms: the terms and their fixed fields."""
    material = scene.bodies[body].material
    terms = {material.elastic.name: material.elastic.value, **material.terms}
    return tuple(
        (name, tuple((k, repr(v)) for k, v in term.model_dump().items() if k not in term.parameters))  # type: ignore[attr-defined]
        for name, term in terms.items()
    )


def sample(scene: Scene) -> Particles:
    """Sample every body.

    Raises:
        SceneError: a body is empty, outside the world or inside another body, a region holds no particle, or there is
            too little memory.
    """
    problems, warnings = file_problems(scene)
    if problems := problems or list(bodies_of_another_size(scene)):
        raise SceneError(problems)
    keys = {body: stress_key(scene, body) for body in scene.bodies}
    first_of = list(dict.fromkeys(keys.values()))
    names = tuple(sorted(scene.bodies, key=lambda body: first_of.index(keys[body])))
    require_memory(scene)
    points, volumes, spacing = {}, {}, {}
    for name in names:
        points[name], volumes[name] = fill(scene, name)
        layout = Layout(scene.dim, tuple(len(body.x) for body in points.values()), history_of(scene))
        require_memory(scene, layout)
    problems = geometry_problems(scene, points)
    if problems:
        raise SceneError(problems)
    warnings += sparse_bodies(scene, volumes)
    warnings += bodies_too_close(scene, points, volumes)
    warnings += [*volume_errors(scene, points, volumes), *walls_outside(scene), *planes_between_nodes(scene)]
    room = {name: np.ones(len(volumes[name])) for name in names}
    for name in names:
        spacing[name] = float(volumes[name].mean() ** (1 / scene.dim))
        if scene.bodies[name].unit_mass:
            room[name], volumes[name] = volumes[name], room[name]
    return Particles(
        names,
        layout,
        points,
        np.concatenate([points[name].x for name in names]),
        np.concatenate([volumes[name] for name in names]),
        np.concatenate([room[name] for name in names]),
        spacing,
        tuple(warnings),
    )


def fill(scene: Scene, name: str) -> tuple[BodyPoints, Array]:
    """Return the particles of a body, sorted by grid block, and their volumes (N,) [m^D].

    Every piece is filled separately, in the body's own coordinates, so that a lattice turns with the body.

    Raises:
        SceneError: a piece cannot be filled.
    """
    body, place = scene.bodies[name], scene.bodies[name].place or Place()
    spacing = body.particle_spacing(scene.world.dx)
    local_spacing = None if spacing is None else spacing / place.scale
    x, volume, piece = [], [], []
    for k, (path, shape) in enumerate(body.pieces.items()):
        try:
            positions, volumes = body.sampling.value.sample(shape, local_spacing)
        except UsageError as error:
            path = f"bodies.{name}.{path}"
            raise SceneError([Problem(scene.where(path), path, str(error))]) from error
        x.append(positions)
        volume.append(volumes * place.scale**scene.dim)
        piece.append(np.full(len(positions), k))
    local = np.concatenate(x)
    world = local if body.place is None else place.to_world(local)
    order = block_order(world, scene.world.dx)
    world, local = world[order], local[order]
    points = BodyPoints(scene, name, world, world, local, np.concatenate(piece)[order])
    return points, np.concatenate(volume)[order]


def block_order(x: Array, dx: float) -> Array:
    """Return the order of particles by grid block and then by cell, so that neighbours are close in memory."""
    cell = np.floor(x / dx - 0.5).astype(int)
    block = cell // BLOCK
    keys = [*cell.T[::-1], *block.T[::-1]]
    return np.lexsort(tuple(keys))
