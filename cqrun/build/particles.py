"""Particles of a scene's bodies: sampled once, at rest, in material coordinates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.engine.blocks import BLOCK
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.geometry.place import Place
from cqrun.build.check_particles import (
    bodies_that_hold_on,
    file_problems,
    geometry_problems,
    misfits,
    planes_between_nodes,
    sparse_bodies,
    walls_outside,
)
from cqrun.build.history import history_of
from cqrun.build.regions import BodyPoints
from cqrun.scene.schema import Scene
from cqrun.state import Layout


@dataclass(frozen=True)
class Particles:
    """All particles of a scene, body after body in the order of `names`.

    Attributes:
        names: of the bodies, those with the same stress terms next to each other.
        points: each body's particles, as regions see them.
        x: (N, D) at rest [m].
        volume: (N,) at rest [m^D]; 1 where the body has `unit_mass`.
        room: (N,) what each fills at rest over its `volume`: 1, and [m^D] where the body has `unit_mass`.
        spacing: distance between particles of each body [m].
        warnings: what a user should know.
    """

    names: tuple[str, ...]
    layout: Layout
    points: dict[str, BodyPoints]
    x: Array
    volume: Array
    room: Array
    spacing: dict[str, float]
    warnings: tuple[Problem, ...]

    def of(self, body: str) -> slice:
        """Return a body's slice of the particles."""
        return self.layout.slices()[self.names.index(body)]

    def inside(self, body: str | None, region: Any) -> Array:
        """Return the indices of the particles of a body (or of all) in a region, or by its name, or everywhere."""
        bodies = self.names if body is None else (body,)
        picked = [self.of(name).start + np.flatnonzero(self.points[name].pick(region)) for name in bodies]
        return np.concatenate(picked)

    def groups(self, body: str) -> dict[str, Array]:
        """Return the indices of the particles of each of a body's groups, by name."""
        start = self.of(body).start
        return {name: start + np.flatnonzero(held) for name, held in self.points[body].groups.items()}

    def labels(self, body: str) -> Array:
        """Return the group of each of a body's particles (N_b,), -1 for none (the last group that holds it)."""
        points = self.points[body]
        labels = np.full(len(points.x), -1)
        for k, held in enumerate(points.groups.values()):
            labels[held] = k
        return labels


def stress_key(scene: Scene, body: str) -> tuple[Any, ...]:
    """Return what bodies with the same stress terms have in common: the terms and what is not a parameter."""
    material = scene.bodies[body].material
    terms = {material.elastic.name: material.elastic.value, **material.terms}
    return tuple(
        (name, tuple((k, v) for k, v in term.model_dump().items() if k not in term.parameters))  # type: ignore[attr-defined]
        for name, term in terms.items()
    )


def sample(scene: Scene) -> Particles:
    """Sample every body.

    Raises:
        SceneError: a body is empty, outside the world or inside another; a region holds nothing.
    """
    problems, warnings = file_problems(scene)
    if problems:
        raise SceneError(problems)
    keys = {body: stress_key(scene, body) for body in scene.bodies}
    first_of = list(dict.fromkeys(keys.values()))
    names = tuple(sorted(scene.bodies, key=lambda body: first_of.index(keys[body])))
    points, volumes, spacing = {}, {}, {}
    for name in names:
        points[name], volumes[name] = fill(scene, name)
    problems = geometry_problems(scene, points)
    if problems:
        raise SceneError(problems)
    warnings += [*sparse_bodies(scene, volumes), *bodies_that_hold_on(scene, points, volumes)]
    warnings += [*misfits(scene, points, volumes), *walls_outside(scene), *planes_between_nodes(scene)]
    room = {name: np.ones(len(volumes[name])) for name in names}
    for name in names:
        spacing[name] = float(volumes[name].mean() ** (1 / scene.dim))
        if scene.bodies[name].unit_mass:
            room[name], volumes[name] = volumes[name], room[name]
    layout = Layout(scene.dim, tuple(len(points[name].x) for name in names), history_of(scene))
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
    """Return a body's particles, block after block of the grid, and their volumes (N,) [m^D].

    Every piece is filled on its own, in the body's own coordinates, so that a lattice turns with the body.

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
    """Return the order of particles by grid block, then by cell: neighbours in space lie together in memory."""
    cell = np.floor(x / dx - 0.5).astype(int)
    block = cell // BLOCK
    keys = [*cell.T[::-1], *block.T[::-1]]
    return np.lexsort(tuple(keys))
