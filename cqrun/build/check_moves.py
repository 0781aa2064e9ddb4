"""Where boundaries that move carry what they hold: into another body, into an obstacle, or out of the world.

A boundary that moves does not give way. So a path that leads through something is asked about before the run. What
happens beside the path, to parts that are not held, is seen only afterwards (running/passing.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from cqrun.build.alignment import HOLDS
from cqrun.build.particles import Particles
from cqrun.build.regions import boundary
from cqrun.engine.reference.moves import rotation_matrix
from cqrun.errors import Problem
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene

PLACES = 64
"""Places along a path that are looked at."""

MOST_POINTS = 2000
"""Largest number of held particles that are looked at."""


def moving_warnings(scene: Scene, particles: Particles) -> Iterator[Problem]:
    """Yield a question about every boundary whose path leads through something."""
    size = np.array(scene.world.size)
    for name, chosen in scene.boundaries.items():
        spec: Any = boundary(scene, name)
        if not getattr(spec, "moves", False) or getattr(spec, "to", None) is not None:
            continue
        held, path = held_by(spec, particles.x, size), f"boundaries.{name}.{chosen.name}"
        for body in particles.names:
            own = particles.x[particles.of(body)][held[particles.of(body)]]
            if len(own):
                steps = list(_steps(scene, spec, own[:: -(-len(own) // MOST_POINTS)]))
                for message in _met(scene, particles, name, body, steps):
                    yield Problem(scene.where(path), path, message)


def held_by(spec: Any, x: Array, size: Array) -> Array:
    """Return which points (n, D) a boundary contains, as bool (n,)."""
    return np.any([inside for inside, _ in spec.places(x, size)], axis=0)


def _steps(scene: Scene, spec: Any, x: Array) -> Iterator[tuple[float, Array]]:
    """Yield the time [s] and the places of held points x (n, D) along the path of their boundary."""
    duration = scene.time.duration
    times = np.linspace(0.0, min(spec.over or duration, duration), PLACES + 1)[1:]
    yield from zip(times.tolist(), carried(scene, spec, x, times), strict=True)


def carried(scene: Scene, spec: Any, x: Array, times: Array) -> Iterator[Array]:
    """Yield the places of points x (n, D) that a boundary holds, at some times [s]."""
    if not spec.moves:
        yield from (x for _ in times)
        return
    dim, over = scene.dim, spec.over or scene.time.duration
    to = np.array(spec.carried_to(dim), float)
    center = x.mean(axis=0) if spec.center is None else np.array(spec.center)
    for time in times:
        part = min(time / over, 1.0)
        yield x + part * to[:dim] + (x - center) @ rotation_matrix(part * to[dim:]).T


def _met(scene: Scene, particles: Particles, name: str, body: str, steps: list[tuple[float, Array]]) -> Iterator[str]:
    """Yield what a part of a body meets on its way, each thing once."""
    size, carries = np.array(scene.world.size), f"carries '{body}'"
    at_rest = scene.job == "rest"

    def first(inside: Any) -> str | None:
        """Return when a point is first inside something, in words."""
        for time, x in steps:
            if inside(x).any():
                return " on its way" if at_rest else f" at t = {time:.3g} s"
        return None

    if when := first(lambda x: ((x < 0) | (x > size)).any(axis=1)):
        yield f"{carries} out of the world{when}: is that meant? Else enlarge world.size, or let it move less"
    for other in scene.boundaries:
        obstacle: Any = boundary(scene, other)
        if obstacle.is_obstacle and (when := first(lambda x, it=obstacle: held_by(it, x, size))):
            yield (
                f"{carries} into the obstacle `{other}`{when}: a boundary that moves does not give way, so the body is "
                "crushed there; let it move less, or move one of them"
            )
    for other in particles.names:
        if other == body:
            continue
        shape = scene.bodies[other].whole()
        when = first(shape.inside)
        if when is None:
            continue
        kept = first(lambda x, it=shape: it.inside(x) & _held_elsewhere(scene, name, x))
        if kept:
            yield (
                f"{carries} to where '{other}' is held{kept}: both cannot be there, and one is crushed or passes "
                "through the other; let it move less, or move one of them"
            )
        else:
            yield f"{carries} to where '{other}' starts{when}, so '{other}' has to make way: is that meant?"


def _held_elsewhere(scene: Scene, name: str, x: Array) -> Array:
    """Return which points (n, D) lie in a boundary that holds bodies in place, and is not `name`."""
    out = np.zeros(len(x), bool)
    for other, chosen in scene.boundaries.items():
        spec: Any = boundary(scene, other)
        if other != name and chosen.name in HOLDS and not getattr(spec, "moves", False):
            out |= held_by(spec, x, np.array(scene.world.size))
    return out
