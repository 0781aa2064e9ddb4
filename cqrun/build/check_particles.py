"""What only the particles show: bodies outside the world or inside each other, regions that hold nothing.

Every function takes `points`, the sampled particles of each body by name, and returns problems with their key
paths; the model builder raises them before a run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from cqrun.boundaries.condition import BoundaryCondition
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import NamesBody, body_of, marked_fields
from cqrun.errors import Problem, UsageError
from cqrun.geometry.file_shape import FileShape
from cqrun.geometry.half_space import HalfSpace
from cqrun.geometry.place import Place
from cqrun.geometry.region import Region
from cqrun.geometry.shape import Shape, cell_centres, counted_volume, finite_bounds
from cqrun.scene.keypath import joined
from cqrun.build.regions import BodyPoints, boundary
from cqrun.scene.files import unreadable_files
from cqrun.scene.schema import Scene
from cqrun.scene.walk import marked, parts

ROUNDED = 1e-9
"""Of a length: a multiple of another one, however both are rounded."""

HOLDS_ON = 1.5
"""Cells between two bodies below which they hold on to each other."""

Points = Mapping[str, BodyPoints]

INWARD = 1e-6
"""Of a part's size: particles nearer to a face of another part than that lie on it, and not inside."""

MISFIT = 0.02
"""Part of a shape's volume by which particles may miss it before it is told."""

CHANCE = 3.0
"""Standard deviations of what a lattice misses of a round shape, where cells at its surface count or do not."""

_MEASURING_CELLS = 200_000
"""That tell the volume of a shape without a formula to some thousandths, quickly."""

READ_WHEN_BUILT = ("bodies", "regions", "boundaries", "loads", "actuators")
"""The sections whose files are read as a scene is built; those of others are read by who needs them."""

PROBES = 16
"""Points along every axis that ask how much of a part lies in another."""


def file_problems(scene: Scene) -> tuple[list[Problem], list[Problem]]:
    """Return what is wrong with the files that a scene is built from, and warnings on those of shapes."""
    problems, warnings = unreadable_files(scene, READ_WHEN_BUILT), []
    unreadable = {problem.path for problem in problems}
    for loc, part in parts(scene):
        path = joined((*loc, "file"))
        if isinstance(part, FileShape) and path not in unreadable:
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
        *overlapping_parts(scene, points),
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


def overlapping_parts(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield pairs of parts that share space: each is filled on its own, so it would be filled twice."""
    for name, body in scene.bodies.items():
        place, held = body.place or Place(), points[name]
        x = [place.to_local(held.world[held.piece == k]) for k in range(len(body.pieces))]
        for (k, (first, one)), (m, (second, other)) in combinations(enumerate(body.pieces.items()), 2):
            share = max(_share(one, other), _share(other, one), _filled(x[k], one, other), _filled(x[m], one, other))
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


def _filled(x: Array, shape: Shape, other: Shape) -> float:
    """Return how many of the particles at x (n, D) lie inside two shapes, and not on a face of either: 0 to 1."""
    both = x[_near(x, shape) & _near(x, other)]
    if not len(both):
        return 0.0
    step = INWARD * float(np.ptp(x, axis=0).max())
    for move in (0.0, *(sign * step * axis for axis in np.eye(x.shape[1]) for sign in (-1.0, 1.0))):
        both = both[shape.inside(both + move) & other.inside(both + move)] if len(both) else both
    return len(both) / len(x)


def _near(x: Array, shape: Shape) -> Array:
    lower, upper = shape.bounds()
    return np.asarray(np.all((x >= lower) & (x <= upper), axis=1))


def empty_regions(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield groups, and regions of what acts on particles, that hold no particle of their body."""
    for body, spec in scene.bodies.items():
        for name in spec.material_of:
            yield from _empty(scene, f"bodies.{body}.material_of.{name}", name, {body: points[body]})
        for group in (*spec.colours, *spec.groups):
            path = f"bodies.{body}.groups.{group}" if group in spec.groups else _placed(scene, body)
            what = "holds" if group in spec.groups else f"the colour '{group}' holds"
            yield from _empty(scene, path, group, {body: points[body]}, what)
    for found in marked(scene, Choice):
        if isinstance(found.value.value, Region) and marked_fields(type(found.part), NamesBody):
            owner = body_of(found.part)
            held = {owner: points[owner]} if owner is not None else points
            yield from _empty(scene, joined(found.loc), found.value, held)


def _empty(
    scene: Scene, path: str, region: Chosen[Region] | str, points: Points, what: str = "holds"
) -> Iterator[Problem]:
    filled = {name: body.world for name, body in points.items() if len(body.world)}
    try:
        held = any(points[name].pick(region).any() for name in filled)
    except UsageError as error:
        yield _problem(scene, path, str(error))
        return
    if filled and not held:  # a body without particles is told of by itself
        named = isinstance(region, str)  # of a body, in the coordinates of its shape
        extents = [
            f"'{name}' lies within {_corner(x.min(axis=0))} to {_corner(x.max(axis=0))} m{where}"
            for name in filled
            for x, where in [_as_described(scene, points, name) if named else (filled[name], "")]
        ]
        yield _problem(scene, path, f"{what} no particle: {', '.join(extents)}")


def _as_described(scene: Scene, points: Points, body: str) -> tuple[Array, str]:
    """Return a body's particles in the coordinates of its shape, and what is said of these."""
    return points[body].local, " before it is placed" if scene.bodies[body].place is not None else ""


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


def misfits(scene: Scene, points: Points, volumes: Mapping[str, Array]) -> Iterator[Problem]:
    """Yield warnings for pieces whose particles make up another volume, and so another mass, than their shapes.

    A lattice counts cells in full. Where a shape fills its bounds, as a box, whole rows are too many or too few; of a
    round one each cell at its surface counts by chance, and a few particles cannot do better.

    Args:
        scene: the scene.
        points: particles by body.
        volumes: particle volumes (N,) [m^3; 2D: m^2] by body, before any `unit_mass`, which needs none.
    """
    for name, body in scene.bodies.items():
        scale = (body.place or Place()).scale
        spacing = body.particle_spacing(scene.world.dx)
        for k, (path, shape) in enumerate(body.pieces.items()) if not body.unit_mass else ():
            own = volumes[name][points[name].piece == k]
            lower, upper = finite_bounds(shape)
            known = type(shape).volume is not Shape.volume
            volume = shape.volume() if known else counted_volume(shape, _MEASURING_CELLS)
            chance = 0.0 if volume > 0.999 * np.prod(upper - lower) else _chance(len(own), scene.dim)
            wanted = scale**scene.dim * volume
            if abs(own.sum() / wanted - 1) > max(MISFIT, chance) * (1 + 1e-9):
                unit = "m^2" if scene.dim == 2 else "m^3"
                message = (
                    f"its particles make up {own.sum():.4g} {unit}, {own.sum() / wanted - 1:+.1%} beside the "
                    f"{wanted:.4g} {unit} of the shape, and its mass is wrong by as much: "
                )
                yield _problem(scene, f"bodies.{name}.{path}", message + _mend(scale * (upper - lower), spacing))


def _chance(count: int, dim: int) -> float:
    """Return what part of `count` cells a lattice may miss of a round shape: 2 D n^(1 - 1/D) are at its surface."""
    at_surface = 2 * dim * max(1, count) ** (1 - 1 / dim)
    return CHANCE * float(np.sqrt(at_surface / 12)) / max(1, count)


def _mend(size: Array, spacing: float | None) -> str:
    """Return what makes particles fill a shape of a size (D,) [m]."""
    if spacing is None:
        return "give another count, or `sampling: {random: {count: ...}}`, whose particles share the shape's own volume"
    rows = size / spacing
    odd = [f"{size[k]:.6g} m along {'xyz'[k]}" for k in np.flatnonzero(np.abs(rows - np.round(rows)) > ROUNDED * rows)]
    if not odd:
        return "give a smaller spacing, or `sampling: {random: {count: ...}}`, which shares out the shape's own volume"
    return (
        f"{' and '.join(odd)} {'is no multiple' if len(odd) == 1 else 'are no multiples'} of the spacing of "
        f"{spacing:.6g} m; give a size that is one, another spacing, or `sampling: {{lattice: {{count: ...}}}}`"
    )


def walls_outside(scene: Scene) -> Iterator[Problem]:
    """Yield warnings for faces at the far end of an axis that no row of nodes meets: their wall stands outside."""
    dx = scene.world.dx
    for axis, size in enumerate(scene.world.size):
        letter, cells = "xyz"[axis], max(1, round(size / dx))
        for name, chosen in scene.boundaries.items():
            spec = chosen.value
            if not isinstance(spec, BoundaryCondition) or spec.face not in (f"{letter}_max", "all"):
                continue
            held = dx * np.ceil((size * (1 - ROUNDED) - spec.thickness) / dx)
            if held > size * (1 + ROUNDED):
                message = (
                    f"{size:.6g} m along {letter} is no multiple of dx = {dx:.6g} m, so '{name}' holds what is beyond "
                    f"{held:.6g} m, {held - size:.3g} m outside the world; give dx = {size / cells:.6g} m, or a "
                    f"size of {cells * dx:.6g} m"
                )
                yield _problem(scene, f"world.size.{axis}", message)
                break


def planes_between_nodes(scene: Scene) -> Iterator[Problem]:
    """Yield warnings for half-spaces across an axis that no row of nodes meets: what they hold begins below them."""
    dx = scene.world.dx
    for name, chosen in scene.boundaries.items():
        region = boundary(scene, name).region
        shape = None if region is None else region.value
        if not isinstance(shape, HalfSpace) or len(across := np.flatnonzero(shape.normal)) != 1:
            continue
        axis = int(across[0])
        outward, place = float(np.sign(shape.normal[axis])), shape.point[axis]
        row = outward * place / dx
        if abs(row - round(row)) > ROUNDED * max(1.0, abs(row)):
            inner, outer = (outward * dx * side + 0.0 for side in (np.floor(row), np.ceil(row)))
            message = (
                f"its plane at {'xyz'[axis]} = {place:.6g} m lies between two rows of nodes: what it holds begins at "
                f"{inner:.6g} m, {abs(place - inner):.3g} m behind it; put it at {inner:.6g} or {outer:.6g} m, or give "
                f"a dx of which {place:.6g} m is a multiple"
            )
            yield _problem(scene, f"boundaries.{name}.{chosen.name}.region", message)


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
