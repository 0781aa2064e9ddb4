"""What only the particles show: bodies outside the world or inside each other, regions that hold nothing.

Every function takes `points`, the sampled particles (N, D) [m] of each body by name, and returns problems
with their key paths; the model builder raises them before a run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np

from cqrun.choice import Chosen
from cqrun.contract import Array
from cqrun.errors import Problem
from cqrun.geometry.shape import Shape
from cqrun.scene.keypath import joined
from cqrun.scene.schema import Scene
from cqrun.scene.walk import parts

Points = Mapping[str, Array]


def geometry_problems(scene: Scene, points: Points, margin: float = 0.0) -> list[Problem]:
    """Return every problem of the placement.

    Args:
        scene: the scene.
        points: particles (N, D) [m] by body.
        margin: how far from the world's faces every particle must stay [m].
    """
    return [
        *empty_bodies(scene, points),
        *outside_world(scene, points, margin),
        *overlapping_bodies(scene, points),
        *empty_regions(scene, points),
    ]


def empty_bodies(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield bodies without a particle."""
    for name, x in points.items():
        if not len(x):
            message = "holds no particle: it is thinner than the particles' spacing, or empty"
            yield _problem(scene, f"bodies.{name}.shape", message)


def outside_world(scene: Scene, points: Points, margin: float = 0.0) -> Iterator[Problem]:
    """Yield bodies that leave the world, one problem for each axis and side."""
    upper = np.array(scene.world.size)
    for name, x in points.items():
        if not len(x):
            continue
        for axis, letter in enumerate("xyz"[: scene.dim]):
            low, high = margin, upper[axis] - margin
            for reach, out in ((x[:, axis].min(), "below"), (x[:, axis].max(), "above")):
                if reach < low if out == "below" else reach > high:
                    limit = low if out == "below" else high
                    message = (
                        f"reaches {letter} = {reach:.6g} m, {out} {limit:.6g} m: the world holds "
                        f"particles from {low:.6g} to {high:.6g} m; move the body or enlarge the world"
                    )
                    yield _problem(scene, f"bodies.{name}.shape", message)


def overlapping_bodies(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield pairs of bodies where one's particles lie inside the other; bodies that only touch may."""
    for first, second in combinations(points, 2):
        hits = [*_hits(scene, points[first], second), *_hits(scene, points[second], first)]
        if hits:
            place = ", ".join(f"{c:.6g}" for c in hits[0])
            message = f"overlaps the body '{first}' in {len(hits)} particles, such as at ({place}) m"
            yield _problem(scene, f"bodies.{second}.shape", f"{message}; move one of them")


def _hits(scene: Scene, x: Array, body: str) -> Array:
    """Return the points inside a body's shape."""
    shape = scene.bodies[body].shape.value
    lower, upper = shape.bounds()
    near = x[np.all((x >= lower) & (x <= upper), axis=1)]
    return near[shape.inside(near)] if len(near) else near


def empty_regions(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield groups, and regions of loads and actuators, that hold no particle of their body."""
    for body, spec in scene.bodies.items():
        for group, shape in spec.groups.items():
            yield from _empty(scene, f"bodies.{body}.groups.{group}", shape, {body: points[body]})
    for loc, part in parts(scene):
        region = getattr(part, "region", None)
        if not (isinstance(region, Chosen) and isinstance(region.value, Shape) and hasattr(part, "body")):
            continue
        body = part.body
        held = {body: points[body]} if body is not None else points
        yield from _empty(scene, joined((*loc, "region")), region, held)


def _empty(scene: Scene, path: str, region: Chosen[Shape], points: Points) -> Iterator[Problem]:
    if not any(region.value.inside(x).any() for x in points.values() if len(x)):
        extents = [
            f"'{name}' lies within {_corner(x.min(axis=0))} to {_corner(x.max(axis=0))} m"
            for name, x in points.items()
            if len(x)
        ]
        yield _problem(scene, path, f"holds no particle: {', '.join(extents) or 'there are none'}")


def _corner(x: Array) -> str:
    return "(" + ", ".join(f"{c:.6g}" for c in x) + ")"


def sparse_bodies(scene: Scene, volumes: Mapping[str, Array]) -> list[Problem]:
    """Return warnings for bodies with fewer than two particles a cell and axis.

    Args:
        scene: the scene.
        volumes: particle volumes (N,) [m^3; 2D: m^2] by body, before any `unit_mass`.
    """
    wanted, found = 2**scene.dim, []
    for name, volume in volumes.items():
        if not len(volume):
            continue
        in_cell = scene.world.dx**scene.dim / float(volume.mean())
        if in_cell < wanted * (1 - 1e-9):
            message = (
                f"{in_cell:.3g} particles in a cell are few: below {wanted} (two an axis) a body "
                "may break apart as it stretches"
            )
            key = "sampling" if scene.bodies[name].particles_per_cell is None else "particles_per_cell"
            key = "spacing" if scene.bodies[name].spacing is not None else key
            found.append(_problem(scene, f"bodies.{name}.{key}", message))
    return found


def _problem(scene: Scene, path: str, message: str) -> Problem:
    return Problem(scene.where(path), path, message)
