"""Bodies that start close to each other: what happens there depends on the frame, and few people expect it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from cqrun.build.regions import BodyPoints
from cqrun.errors import Problem
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

TOO_CLOSE = 1.5
"""In the updated frame, bodies that start closer than this stick together [cells]."""

TOUCHING = 0.25
"""In the reference frame, bodies that start closer than this look as if they were meant to be one piece [cells]."""


def bodies_too_close(scene: Scene, points: Mapping[str, BodyPoints], volumes: Mapping[str, Array]) -> Iterator[Problem]:
    """Yield a warning for each pair of bodies that start so close that they stick together, or look as if they should.

    Bodies of the updated frame share nodes. On these the gap between them counts as unstretched material: they stick
    together until they are torn apart (tests/engine/test_engine_clinging.py). Bodies that meet later stay a cell apart
    and separate again. Bodies of the reference frame never stick together.

    Args:
        scene: the scene.
        points: particles by body.
        volumes: particle volumes (N,) [m^3; 2D: m^2] by body, before any `unit_mass`.
    """
    dx = scene.world.dx
    near = (TOUCHING if scene.bodies_meet else TOO_CLOSE) * dx * (1 - 1e-9)
    for first, second in combinations((name for name in points if len(volumes[name])), 2):
        # a surface is half a spacing beyond its particles
        inside = sum(0.5 * float(volumes[name].mean()) ** (1 / scene.dim) for name in (first, second))
        gaps, _ = cKDTree(points[first].world).query(points[second].world, distance_upper_bound=near + inside)
        if not np.isfinite(gaps).any():
            continue
        gap = max(0.0, float(gaps.min()) - inside) / dx
        spec = scene.bodies[second]
        path = f"bodies.{second}." + ("place" if spec.place else "shape" if spec.shape else "parts")
        yield Problem(scene.where(path), path, _told(scene, first, gap))


def _told(scene: Scene, first: str, gap: float) -> str:
    if scene.bodies_meet:
        return (
            f"touches the body '{first}' from the start, but is not joined to it: bodies press on each other, slide "
            "and separate; if they should be one piece, make them `parts` of one body, with a group for each"
        )
    return (
        f"starts {gap:.1f} cells from the body '{first}': bodies that start so close stick together as if "
        f"glued; if they should separate, leave {TOO_CLOSE * scene.world.dx:.3g} m between them"
    )
