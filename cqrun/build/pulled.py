"""How far clamps pull a body before the run ends, and the substep that its waves need there.

A law of rubber becomes stiffer as it is stretched, and what hardly changes its volume becomes stiffer across the pull.
The bound at rest, of which `auto` takes `SAFETY`, covers what stretches up to `MUCH` do.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from cqrun.build.assembly import Assembly
from cqrun.build.check_moves import carried, held_by
from cqrun.build.limits import Limit
from cqrun.build.particles import Particles
from cqrun.build.regions import boundary
from cqrun.build.values import updated
from cqrun.materials.waves import pulled, wave_stiffness
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

MUCH = 1.5
"""Stretch from which waves are counted as they are in the stretched body."""

BETWEEN = 1.15
"""Ratio of the stretches that are tried, up to the largest."""

ABOUT = 1.2
"""Points of two clamps are about nearest if they are at most so many times as far from each other as the nearest."""

MOMENTS = 16
"""Moments of the run at which the distance of two clamps is looked at."""


def pull_limits(
    scene: Scene, particles: Particles, assembly: Assembly, body: str, density: Array, modulus: Array,
    values: dict[str, Array],
) -> list[Limit]:  # fmt: skip
    """Return the bound on the substep of a body that is pulled far, for its fastest particle at rest.

    Args:
        density: (N_b,) [kg/m^D].
        modulus: (N_b,) stiffness of pressure waves at rest [Pa].
        values: by path.
    """
    most = scene.time.stretch or largest_pull(scene, particles, body, values)
    if most < MUCH or scene.job == "rest":  # an equilibrium takes no substeps
        return []
    fastest = int(np.argmax(modulus / density))
    terms, thetas = assembly.terms_at(body, fastest, values)
    spatial, dim = scene.world.frame == "updated", scene.dim
    count = int(np.ceil(np.log(most) / np.log(BETWEEN)))
    states = [F for stretch in np.geomspace(1.0, most, count + 1)[1:] for F in pulled(terms, thetas, stretch, dim)]
    stiffest = max(wave_stiffness(terms, thetas, F, spatial=spatial) for F in states)
    if stiffest <= 0.0:
        return []
    dt = scene.world.dx * float(np.sqrt(density[fastest] / stiffest))
    return [Limit(f"bodies.{body}.material at a stretch of {most:.3g}", dt, estimated=True)]


def largest_pull(scene: Scene, particles: Particles, body: str, values: dict[str, Array]) -> float:
    """Return how far clamps stretch what is between them at most, on the shortest ways; at least 1.

    A clamp that is glued to a rigid body counts as one that does not move: see `time.stretch`.
    """
    x, clamps = particles.x[particles.of(body)], []
    for name, chosen in scene.boundaries.items():
        spec: Any = updated(boundary(scene, name), f"boundaries.{name}.{chosen.name}", values)
        held = held_by(spec, x, np.array(scene.world.size)) if chosen.name == "sticky" else None
        if held is not None and held.any():
            clamps.append((spec, x[held]))
    most = 1.0
    for (one, a), (other, b) in itertools.combinations(clamps, 2):
        if one.moves or other.moves:
            most = max(most, _stretch_between(scene, one, a, other, b))
    return most


def _stretch_between(scene: Scene, one: Any, a: Array, other: Any, b: Array) -> float:
    """Return the largest ratio of the distance of two clamps to that at rest, for points that are about nearest."""
    from scipy.spatial import cKDTree

    away, near = cKDTree(a).query(b)
    if away.min() <= 0.0:
        return 1.0
    k = np.flatnonzero(away <= ABOUT * away.min())
    moments = np.linspace(0.0, scene.time.duration, MOMENTS + 1)[1:]
    ends = zip(carried(scene, one, a, moments), carried(scene, other, b, moments), strict=True)
    return max(float((np.linalg.norm(y[k] - x[near[k]], axis=1) / away[k]).max()) for x, y in ends)
