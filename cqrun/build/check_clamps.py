"""Check that clamps reach the bodies that they are probably meant to hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from cqrun.boundaries.sticky import Sticky
from cqrun.build.particles import Particles
from cqrun.engine.model import ConditionModel
from cqrun.engine.setting import MARGIN, grid_shape
from cqrun.errors import Problem
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

NEAR = 3.0
"""A clamp that holds no particle is reported if a body is this close [cells]. One that is farther away may be a floor
or an obstacle: it is reported if the nearest body is not held elsewhere, and does not start to move towards it."""


class Nearest(NamedTuple):
    """The particle that is nearest to a boundary: the name of its body, and its distance from the held nodes [m]."""

    body: str
    distance: float

    def told(self, dx: float) -> str:
        """Return the distance in words."""
        return f"the nearest particle is of '{self.body}', {self.distance:.3g} m ({self.distance / dx:.2g} cells) away"


def clamp_warnings(
    scene: Scene, particles: Particles, conditions: Sequence[ConditionModel], nearest_nodes: Array
) -> Iterator[Problem]:
    """Yield warnings about sticky regions that hold no particle, although they are probably meant to.

    Args:
        scene: the scene.
        particles: its particles.
        conditions: what holds its nodes.
        nearest_nodes: the index of the nearest node of each particle (N,).
    """
    clamps = [condition for condition in conditions if isinstance(condition.spec, Sticky)]
    held = np.zeros(len(particles.x), bool)
    for condition in clamps:
        held |= condition.nodes[nearest_nodes]
    loose = [name for name in particles.names if not held[particles.of(name)].any()]
    for condition in clamps:
        if condition.spec.region is None or condition.nodes[nearest_nodes].any():
            continue
        nearest = nearest_to(scene, particles, condition.nodes, particles.names)
        if nearest.distance > NEAR * scene.world.dx:
            candidates = [name for name in loose if not _comes(scene, particles, name, condition)]
            if not candidates:
                continue
            nearest = nearest_to(scene, particles, condition.nodes, candidates)
        path = f"boundaries.{condition.name}.{condition.spec.name}.region"
        message = (
            f"holds {int(condition.nodes.sum()):,} nodes but no particle: {nearest.told(scene.world.dx)}; to clamp a "
            "body, let the region reach into it"
        )
        yield Problem(scene.where(path), path, message)


def nearest_to(scene: Scene, particles: Particles, nodes: Array, bodies: Sequence[str]) -> Nearest:
    """Return which particle of some bodies is nearest to held nodes, of which there is at least one.

    Args:
        scene: the scene.
        particles: its particles.
        nodes: which nodes of the grid are held (n,) bool.
        bodies: names of the bodies.
    """
    tree = cKDTree(_positions(scene, nodes))
    found = {name: float(tree.query(particles.x[particles.of(name)])[0].min()) for name in bodies}
    name = min(found, key=found.__getitem__)
    return Nearest(name, found[name])


def _positions(scene: Scene, nodes: Array) -> Array:
    """Return the positions of held nodes (M, D) [m]."""
    shape = grid_shape(np.array(scene.world.size), scene.world.dx)
    return np.asarray((np.argwhere(nodes.reshape(shape)) - MARGIN) * scene.world.dx)


def _comes(scene: Scene, particles: Particles, name: str, condition: ConditionModel) -> bool:
    """Return whether a body falls or flies straight towards held nodes, seen with a cell on each side."""
    nodes, x = _positions(scene, condition.nodes), particles.x[particles.of(name)]
    for direction in (np.array(scene.world.gravity), np.array(scene.bodies[name].velocity)):
        if not direction.any():
            continue
        along = direction / np.linalg.norm(direction)
        aside = [each - np.outer(each @ along, along) for each in (nodes, x)]
        close = scene.world.dx
        meets = (aside[0].min(0) <= aside[1].max(0) + close) & (aside[1].min(0) <= aside[0].max(0) + close)
        if meets.all() and (nodes @ along).max() > (x @ along).min():
            return True
    return False
