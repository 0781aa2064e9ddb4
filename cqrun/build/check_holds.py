"""Check what boundaries hold in the reference frame: bodies that are loose, or wholly held, and nodes held twice."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cqrun.build.alignment import HOLDS, grid_offset
from cqrun.build.particles import Particles
from cqrun.engine.model import ConditionModel
from cqrun.engine.reference.held import held_at
from cqrun.engine.reference.patches import make_patches
from cqrun.engine.statics.holding import Planes, loose_bodies
from cqrun.errors import Problem
from cqrun.explain import listed
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene


class Reached(NamedTuple):
    """All nodes that particles reach: their places at rest (M, D) [m], and the body of each (M,)."""

    X: Array
    body: Array


def reached_nodes(scene: Scene, particles: Particles) -> Reached:
    """Return the nodes that particles reach."""
    dx = scene.world.dx
    patches = make_patches(particles.layout, particles.x, dx, grid_offset(scene, particles))
    reached = np.zeros(patches.n_nodes, bool)
    steps = np.stack(np.meshgrid(*[np.arange(3)] * scene.dim, indexing="ij"), -1).reshape(-1, scene.dim)
    for step in steps @ np.array(patches.strides[3 - scene.dim :]):
        reached[patches.first + step] = True
    return Reached(patches.positions(dx)[reached], patches.body_of_nodes()[reached])


def unheld_problems(scene: Scene, particles: Particles, conditions: Sequence[ConditionModel]) -> list[Problem]:
    """Return the bodies that could move without resistance, so that they have no place of rest."""
    nodes = reached_nodes(scene, particles)
    loose = loose_bodies(particles.names, nodes.body, nodes.X, _planes(scene, nodes, conditions).holding())
    return [held_problem(scene, name, ways) for name, ways in loose.items()]


def held_problem(scene: Scene, body: str, ways: int) -> Problem:
    """Return the problem of a body that can move in so many ways without resistance."""
    path = f"bodies.{body}"
    message = (
        f"nothing holds it: it can move in {ways} way{'s' if ways > 1 else ''} without resistance, so it has no "
        "place of rest; add a `sticky` boundary that holds some of its particles"
    )
    return Problem(scene.where(path), path, message)


def hold_warnings(scene: Scene, particles: Particles, conditions: Sequence[ConditionModel]) -> Iterator[Problem]:
    """Yield warnings about bodies that cannot move at all, and about nodes that two boundaries hold alike."""
    if scene.world.frame != "reference" or not any(condition.spec.name in HOLDS for condition in conditions):
        return
    nodes = reached_nodes(scene, particles)
    planes = _planes(scene, nodes, conditions)
    yield from _wholly_held(scene, particles, nodes, planes)
    moving = {c.name for c in conditions if getattr(c.spec, "moves", False)}
    for (taker, other), count in planes.alike().items():
        path = f"boundaries.{taker}"
        both = f"'{taker}' and '{other}' both hold {count} node{'s' if count > 1 else ''} of the grid"
        if taker in moving:
            stays = "also moves" if other in moving else "stays where it is"
            message = (
                f"{both}: they go where '{taker}' goes, although '{other}' {stays}, and their reaction counts for "
                f"'{taker}' alone; make one region smaller, with at least two cells between them"
            )
        else:
            message = (
                f"{both}: their reaction cannot be divided, and counts for '{taker}', the first in the scene; "
                "it does not matter unless their forces are read"
            )
        yield Problem(scene.where(path), path, message)


def _wholly_held(scene: Scene, particles: Particles, nodes: Reached, planes: Planes) -> Iterator[Problem]:
    """Yield warnings about bodies of which nothing can move."""
    holding = planes.holding()
    stuck = np.zeros(len(nodes.X), bool)
    stuck[holding.nodes[~np.any(holding.free, axis=(1, 2))]] = True
    for k, name in enumerate(particles.names):
        if stuck[nodes.body == k].all():
            path = f"bodies.{name}"
            holders = [f"'{each}'" for each in planes.names if planes.of(each)[nodes.body == k].any()]
            message = f"nothing of it can move: {listed(holders)} hold{'s' * (len(holders) == 1)} every node around it"
            yield Problem(scene.where(path), path, f"{message}; make the boundary smaller")


def _planes(scene: Scene, nodes: Reached, conditions: Sequence[ConditionModel]) -> Planes:
    size = np.array(scene.world.size)
    return Planes(conditions, size, held_at(conditions, nodes.X, size).bits, nodes.X)
