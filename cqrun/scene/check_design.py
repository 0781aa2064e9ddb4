"""What the bounds of geometric unknowns allow: that at none of them a body is where, or as thin as, it cannot be."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cqrun.contract import Array
from cqrun.errors import Problem, SceneError
from cqrun.scene.check import outside_world, overlapping_bodies, overlapping_parts
from cqrun.scene.geometry import Geometry
from cqrun.scene.particles import Particles
from cqrun.scene.paths import canonical, shapes_a_body, with_values
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import start, tied

ROUNDING = 1e-6
MANY = 16
"""Unknowns of geometry of which not every pair is tried."""

NEIGHBOURS = 6
"""Of a particle, whose distances tell how far apart a body's particles have come."""


def design_problems(scene: Scene, particles: Particles) -> list[Problem]:
    """Return what is wrong with geometric unknowns and their bounds.

    Each bound is tried alone, all at one side together, and one at its upper with another at its lower bound.
    """
    unknowns = {path: unknown for path, unknown in scene.unknowns.items() if _geometric(scene, path, 0.0)}
    starts = {p: v for path in unknowns for p, v in _geometric(scene, path, start(scene, path)).items()}
    trials = [(path, {path: end}) for path, unknown in unknowns.items() for end in unknown.bounds]
    if len(unknowns) > 1:
        first = next(iter(unknowns))
        trials += [(first, {path: unknown.bounds[side] for path, unknown in unknowns.items()}) for side in (0, 1)]
    found = list(_tried(scene, particles, trials, starts))
    if not found and len(unknowns) <= MANY:  # two that come towards each other
        pairs = [
            (path, {path: unknowns[path].bounds[1], other: unknowns[other].bounds[0]})
            for path, other in itertools.permutations(unknowns, 2)
        ]
        found = list(_tried(scene, particles, pairs, starts))
    return found


def _tried(
    scene: Scene, particles: Particles, trials: Sequence[tuple[str, Mapping[str, float]]], starts: Mapping[str, float]
) -> Iterator[Problem]:
    """Yield what is wrong at trials: the unknown to name, and the values of unknowns by path."""
    for path, ends in trials:
        told = f"unknowns.{path}.bounds"
        at, values = _words(ends), {p: v for path, end in ends.items() for p, v in _geometric(scene, path, end).items()}
        for message in _at(scene, particles, {**starts, **values}, starts):
            yield Problem(scene.where(told), told, f"{at} {message}; narrow the bounds")
            break  # the first says enough: one bound often breaks several rules


def _is_geometric(scene: Scene, path: str) -> bool:
    return shapes_a_body(canonical(scene, path).split("."))


def _geometric(scene: Scene, path: str, value: float) -> dict[str, float]:
    """Return the values of an unknown and its followers that shape or place a body."""
    return {p: v for p, v in tied(scene, path, value).items() if _is_geometric(scene, p)}


def _words(ends: Mapping[str, float]) -> str:
    if len(ends) == 1:
        return f"at {next(iter(ends.values())):g}"
    if len(ends) == 2:
        return "with " + " and ".join(f"{path} at {end:g}" for path, end in ends.items())
    return "with all geometric unknowns at " + ", ".join(f"{end:g}" for end in ends.values())


def _at(scene: Scene, particles: Particles, values: Mapping[str, float], starts: Mapping[str, float]) -> Iterator[str]:
    """Yield what is wrong at some values of the geometric unknowns."""
    try:
        changed = with_values(scene, values)
    except SceneError as error:
        yield f"the scene is none: {error.problems[0].path} {error.problems[0].message}"
        return
    geometry = Geometry(scene, particles)
    arrays = {canonical(scene, path): np.array(value) for path, value in values.items()}
    x, volume = geometry.at_rest(arrays)
    if (volume <= 0).any():
        yield "a part of a body is turned inside out"
        return
    points = {name: replace(body, world=x[particles.of(name)]) for name, body in particles.points.items()}
    problems = [*outside_world(changed, points), *overlapping_bodies(changed, points), *overlapping_parts(changed)]
    yield from (f"{problem.path} {problem.message}" for problem in problems)
    before = geometry.at_rest({canonical(scene, path): np.array(value) for path, value in starts.items()})[0]
    for name in particles.names:
        yield from _sparse(scene, particles, name, before, x)


def _sparse(scene: Scene, particles: Particles, body: str, before: Array, x: Array) -> Iterator[str]:
    """Yield that a body's particles come further apart than half a cell, where they were not so at the start."""
    part, half = particles.of(body), 0.5 * scene.world.dx * (1 + ROUNDING)
    rest, spacing = particles.x[part], particles.spacing[body]
    apart = spacing * _stretch(rest, x[part])
    if spacing * _stretch(rest, before[part]) <= half < apart:
        yield (
            f"bodies.{body} has particles {apart:.4g} m apart, fewer than two in a cell's {scene.world.dx:g} m, so it "
            "may break: give it more particles"
        )


def _stretch(rest: Array, x: Array) -> float:
    """Return by how much neighbours have come apart at most, at least 1."""
    from scipy.spatial import cKDTree

    count = min(NEIGHBOURS, len(rest) - 1)
    if count < 1:
        return 1.0
    distance, near = cKDTree(rest).query(rest, k=count + 1)
    apart = np.linalg.norm(x[near[:, 1:]] - x[:, None], axis=2)
    return max(1.0, float((apart / distance[:, 1:]).max()))
