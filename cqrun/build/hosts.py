"""Bodies as what pulls along routes through them sees them: which points are inside, and which particles are near."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cqrun.build.particles import Particles
from cqrun.forces.routed import Host
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

SURFACE = 0.1
"""A point that is no farther from a body than this lies on its surface [spacings]: a mesh cuts the corners of arcs."""


def host_of(scene: Scene, particles: Particles, body: str) -> Host:
    """Return a body as a route through it sees it."""
    exact = scene.world.frame == "reference"
    return Host(body, particles.x, particles.inside, contains(scene, particles, body), scene.world.dx, exact)


def contains(scene: Scene, particles: Particles, body: str) -> Callable[[Array], Array]:
    """Return a function that says which of some points (n, D) lie in a body, or on its surface (n,)."""
    shape, near = scene.bodies[body].whole(), SURFACE * particles.spacing[body]
    axes = np.eye(scene.dim)
    steps = near * np.concatenate([np.zeros((1, scene.dim)), axes, -axes])

    def inside(points: Array) -> Array:
        return np.any([shape.inside(points + step) for step in steps], axis=0)

    return inside
