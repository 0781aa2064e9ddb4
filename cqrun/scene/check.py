"""What only the particles show: bodies outside the world or inside each other, regions that hold nothing.

Every function takes `points`, the sampled particles of each body by name, and returns problems with their key
paths; the model builder raises them before a run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from cqrun.choice import Chosen
from cqrun.contract import Array
from cqrun.errors import Problem, UsageError
from cqrun.geometry.file_shape import FileShape
from cqrun.geometry.region import Region
from cqrun.geometry.shape import Shape, cell_centres, finite_bounds
from cqrun.scene.keypath import joined
from cqrun.scene.regions import BodyPoints
from cqrun.scene.schema import Scene
from cqrun.scene.walk import parts

HOLDS_ON = 1.5
"""Cells between two bodies below which they hold on to each other."""

Points = Mapping[str, BodyPoints]

PROBES = 16
"""Points along every axis that ask how much of a part lies in another."""


def file_problems(scene: Scene) -> tuple[list[Problem], list[Problem]]:
    """Return what is wrong with the files that shapes are read from, and warnings on them."""
    problems, warnings = [], []
    for loc, part in parts(scene):
        if isinstance(part, FileShape):
            path = joined((*loc, "file"))
            try:
                warnings += [_problem(scene, path, message) for message in part.examine()]
            except UsageError as error:
                problems.append(_problem(scene, path, str(error)))
    return problems, warnings


def geometry_problems(scene: Scene, points: Points, margin: float = 0.0) -> list[Problem]:
    """Return every problem of the placement.

    Args:
        scene: the scene.
        points: particles by body.
        margin: how far from the world's faces every particle must stay [m].
    """
    return [
        *empty_bodies(scene, points),
        *outside_world(scene, points, margin),
        *overlapping_bodies(scene, points),
        *overlapping_parts(scene),
        *empty_regions(scene, points),
        *points_to_track(scene, points),
    ]


def empty_bodies(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield bodies, or parts of them, without a particle."""
    for name, body in points.items():
        for k, path in enumerate(scene.bodies[name].pieces):
            if not (body.piece == k).any():
                message = "holds no particle: it is thinner than the particles' spacing, or empty"
                yield _problem(scene, f"bodies.{name}.{path}", message)


def outside_world(scene: Scene, points: Points, margin: float = 0.0) -> Iterator[Problem]:
    """Yield bodies that leave the world, one problem for each axis and side."""
    upper = np.array(scene.world.size)
    for name, body in points.items():
        x = body.world
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
                    yield _problem(scene, _placed(scene, name), message)


def overlapping_bodies(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield pairs of bodies where one's particles lie inside the other; bodies that only touch may."""
    for first, second in combinations(points, 2):
        hits = [*_hits(scene, points[first].world, second), *_hits(scene, points[second].world, first)]
        if hits:
            place = ", ".join(f"{c:.6g}" for c in hits[0])
            message = f"overlaps the body '{first}' in {len(hits)} particles, such as at ({place}) m"
            yield _problem(scene, _placed(scene, second), f"{message}; move one of them")


def _hits(scene: Scene, x: Array, body: str) -> Array:
    """Return the points inside a body's shape."""
    shape = scene.bodies[body].whole()
    lower, upper = shape.bounds()
    near = x[np.all((x >= lower) & (x <= upper), axis=1)]
    return near[shape.inside(near)] if len(near) else near


def _placed(scene: Scene, body: str) -> str:
    """Return the path of what says where a body is."""
    spec = scene.bodies[body]
    return f"bodies.{body}." + ("place" if spec.place else "shape" if spec.shape else "parts")


def overlapping_parts(scene: Scene) -> Iterator[Problem]:
    """Yield pairs of parts that share space: each is filled on its own, so it would be filled twice."""
    for name, body in scene.bodies.items():
        for (first, one), (second, other) in combinations(body.pieces.items(), 2):
            share = max(_share(one, other), _share(other, one))
            if share > 0:
                message = (
                    f"overlaps the part '{first.partition('.')[2]}', in about {share:.1%} of the smaller: parts are "
                    "filled one by one; move one, cut it out by a `difference`, or make one part a `union` of both"
                )
                yield _problem(scene, f"bodies.{name}.{second}", message)


def _share(shape: Shape, other: Shape) -> float:
    """Return how much of a shape lies in another one, from a few points: between 0 and 1."""
    lower, upper = finite_bounds(shape)
    low, high = other.bounds()
    if (high <= lower).any() or (low >= upper).any():
        return 0.0
    x = cell_centres(lower, (upper - lower) / PROBES, np.full(len(lower), PROBES))
    held = shape.inside(x)
    return float((held & other.inside(x)).sum() / max(1, held.sum()))


def empty_regions(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield groups, and regions of what acts on particles, that hold no particle of their body."""
    for body, spec in scene.bodies.items():
        for name in spec.material_of:
            yield from _empty(scene, f"bodies.{body}.material_of.{name}", name, {body: points[body]})
        for group in (*spec.colours, *spec.groups):
            path = f"bodies.{body}.groups.{group}" if group in spec.groups else _placed(scene, body)
            yield from _empty(scene, path, group, {body: points[body]})
    for loc, part in parts(scene):
        region = getattr(part, "region", None)
        if not (isinstance(region, Chosen) and isinstance(region.value, Region) and hasattr(part, "body")):
            continue
        body = part.body
        held = {body: points[body]} if body is not None else points
        yield from _empty(scene, joined((*loc, "region")), region, held)


def _empty(scene: Scene, path: str, region: Chosen[Region] | str, points: Points) -> Iterator[Problem]:
    filled = {name: body.world for name, body in points.items() if len(body.world)}
    try:
        held = any(points[name].pick(region).any() for name in filled)
    except UsageError as error:
        yield _problem(scene, path, str(error))
        return
    if filled and not held:  # a body without particles is told of by itself
        extents = [
            f"'{name}' lies within {_corner(x.min(axis=0))} to {_corner(x.max(axis=0))} m" for name, x in filled.items()
        ]
        yield _problem(scene, path, f"holds no particle: {', '.join(extents)}")


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


def bodies_that_hold_on(scene: Scene, points: Points, volumes: Mapping[str, Array]) -> Iterator[Problem]:
    """Yield warnings for pairs of bodies that start so near to each other that they do not come apart again.

    What lies between them counts as unstretched where it starts, on the nodes that both share: pulled apart they hold
    on until they tear (tests/engine/test_engine_clinging.py). Bodies that meet later rest a cell apart, and let go.

    Args:
        scene: the scene.
        points: particles by body.
        volumes: particle volumes (N,) [m^3; 2D: m^2] by body, before any `unit_mass`.
    """
    dx = scene.world.dx
    for first, second in combinations((name for name in points if len(volumes[name])), 2):
        # a surface is half a spacing beyond its particles
        inside = sum(0.5 * float(volumes[name].mean()) ** (1 / scene.dim) for name in (first, second))
        near = HOLDS_ON * dx * (1 - 1e-9) + inside
        gaps, _ = cKDTree(points[first].world).query(points[second].world, distance_upper_bound=near)
        if np.isfinite(gaps).any():
            gap = max(0.0, float(gaps.min()) - inside) / dx
            message = (
                f"starts {gap:.1f} cells from the body '{first}': bodies that start so near are joined there, as if "
                f"glued; if they should come apart, leave {HOLDS_ON * dx:.3g} m between them"
            )
            yield _problem(scene, _placed(scene, second), message)


def points_to_track(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield what synthetic data would track that is not on its body."""
    made = scene.synthetic
    if made is None or not len(points[made.body].world):
        return
    x = points[made.body].world
    if (made.tracked or 0) > len(x):
        message = f"tracks {made.tracked:,} particles, but the body '{made.body}' has only {len(x):,}"
        yield _problem(scene, "data.synthetic.tracked", message)
    reach = float(np.linalg.norm(x.max(axis=0) - x.min(axis=0)))
    for name, place in (made.markers or {}).items():
        away = float(np.linalg.norm(x - np.array(place), axis=1).min())
        if away > reach:
            message = (
                f"is {away:.3g} m from the body '{made.body}', which is {reach:.3g} m across: give its rest position "
                "in the scene's own coordinates, in metres"
            )
            yield _problem(scene, joined(("data", "synthetic", "markers", name)), message)


def _problem(scene: Scene, path: str, message: str) -> Problem:
    return Problem(scene.where(path), path, message)
