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
from cqrun.materials.waves import pulled, wave_stiffness
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

MUCH = 1.5
"""Stretch from which waves are counted as they are in the stretched body."""

BETWEEN = 1.15
"""Ratio of the stretches that are tried, up to the largest."""

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
    most = max(largest_pull(scene, particles, body), scene.time.stretch or 1.0)
    if most < MUCH:
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
    return [Limit(f"bodies.{body}.material at a stretch of {most:.3g}", dt)]


def largest_pull(scene: Scene, particles: Particles, body: str) -> float:
    """Return how far clamps stretch the material between them at most, on the shortest way; at least 1."""
    x, clamps = particles.x[particles.of(body)], []
    for name, chosen in scene.boundaries.items():
        spec: Any = boundary(scene, name)
        held = held_by(spec, x, np.array(scene.world.size)) if chosen.name == "sticky" else None
        if held is not None and held.any():
            clamps.append((spec, x[held]))
    most = 1.0
    for (one, a), (other, b) in itertools.combinations(clamps, 2):
        if one.moves or other.moves:
            most = max(most, _stretch_between(scene, one, a, other, b))
    return most


def _stretch_between(scene: Scene, one: Any, a: Array, other: Any, b: Array) -> float:
    """Return the largest ratio of the distance of two clamps to that at rest, for the points that are nearest there."""
    from scipy.spatial import cKDTree

    away, near = cKDTree(a).query(b)
    k = int(np.argmin(away))
    if away[k] <= 0.0:
        return 1.0
    moments = np.linspace(0.0, scene.time.duration, MOMENTS + 1)[1:]
    ends = zip(carried(scene, one, a, moments), carried(scene, other, b, moments), strict=True)
    return max(float(np.linalg.norm(y[k] - x[near[k]])) for x, y in ends) / float(away[k])
