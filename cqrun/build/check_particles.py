"""Checks that need the particles: bodies outside the world or inside each other, regions without particles.

Every function takes `points`, the sampled particles of each body by name, and returns problems with their key paths.
The model builder raises them before a run.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations, islice

import numpy as np

from cqrun.actuators.chamber import is_chamber
from cqrun.boundaries.condition import BoundaryCondition
from cqrun.build.regions import BodyPoints, boundary
from cqrun.errors import Problem, UsageError
from cqrun.geometry.file_shape import FileShape
from cqrun.geometry.half_space import HalfSpace
from cqrun.geometry.lattice import whole_spacing
from cqrun.geometry.place import Place
from cqrun.geometry.region import Region
from cqrun.geometry.shape import Shape, cell_centres, counted_volume, finite_bounds
from cqrun.plugin.choice import Choice, Chosen
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import NamesBody, body_of, marked_fields
from cqrun.scene.files import unreadable_files
from cqrun.scene.keypath import joined
from cqrun.scene.schema import Scene
from cqrun.scene.walk import marked, parts

ROUNDING, FLOAT32 = 1e-9, 1e-6
"""Relative difference up to which a length, or one from a file, counts as a multiple of another."""

Points = Mapping[str, BodyPoints]

INWARD = 1e-6
"""A particle closer than this to a face of another part, relative to the part's size, is on it and not inside."""

VOLUME_ERROR = 0.02
"""Relative volume error of a body's particles above which there is a warning."""

_FITTED = "`sampling: {lattice: {fitted: true}}`"

N_DEVIATIONS = 3.0
"""Allowed volume error of a lattice in a round shape, whose surface cells count or not by chance [std. deviations]."""

_MEASURING_CELLS = 200_000
"""Number of cells that give the volume of a shape without a formula to a few thousandths, and are counted quickly."""

READ_WHEN_BUILT = ("bodies", "regions", "boundaries", "rigid", "loads", "actuators")
"""The sections whose files are read while a scene is built; other files are read by the code that uses them."""

MOST_PAIRS = 20
"""Largest number of pairs of bodies, and of parts, whose overlaps are told; of many copies all pairs overlap."""

PROBES = 16
"""Number of points along every axis by which the overlap of two parts is estimated."""


def file_problems(scene: Scene) -> tuple[list[Problem], list[Problem]]:
    """Return the problems with the files that a scene is built from, and the warnings about files of shapes."""
    problems, warnings = unreadable_files(scene, READ_WHEN_BUILT), []
    unreadable = tuple(problem.path for problem in problems)
    for loc, part in parts(scene):
        path = joined((*loc, "file"))
        if isinstance(part, FileShape) and not any(each.startswith(f"{joined(loc)}.") for each in unreadable):
            try:
                warnings += [_problem(scene, path, message) for message in part.examine()]
            except UsageError as error:
                problems.append(_problem(scene, path, str(error)))
    return problems, warnings


def geometry_problems(scene: Scene, points: Points, margin: float = 0.0) -> list[Problem]:
    """Return all problems with the placement of bodies and regions.

    Args:
        scene: the scene.
        points: particles by body.
        margin: smallest allowed distance of a particle from the faces of the world [m].
    """
    return [
        *empty_bodies(scene, points),
        *outside_world(scene, points, margin),
        *islice(overlapping_bodies(scene, points), MOST_PAIRS),
        *islice(overlapping_parts(scene, points), MOST_PAIRS),
        *empty_regions(scene, points),
        *points_to_track(scene, points),
    ]


def empty_bodies(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield a problem for each body, or part of one, without particles."""
    for name, body in points.items():
        for k, path in enumerate(scene.bodies[name].pieces):
            if not (body.piece == k).any():
                message = "holds no particle: it is thinner than the particles' spacing, or empty"
                yield _problem(scene, f"bodies.{name}.{path}", message)


def outside_world(scene: Scene, points: Points, margin: float = 0.0) -> Iterator[Problem]:
    """Yield bodies that leave the world, one problem for each axis and side, at the part that reaches farthest."""
    upper = np.array(scene.world.size)
    for name, body in points.items():
        x = body.world
        for axis, letter in enumerate("xyz"[: scene.dim]) if len(x) else ():
            low, high = margin, upper[axis] - margin
            for farthest, out in ((x[:, axis].argmin(), "below"), (x[:, axis].argmax(), "above")):
                reach = x[farthest, axis]
                if reach < low if out == "below" else reach > high:
                    limit = low if out == "below" else high
                    message = (
                        f"reaches {letter} = {reach:.6g} m, {out} {limit:.6g} m: the world holds "
                        f"particles from {low:.6g} to {high:.6g} m; move the body or enlarge the world"
                    )
                    yield _problem(scene, _placement_path(scene, name, body.piece[farthest]), message)


def overlapping_bodies(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield a problem for each pair of bodies with particles of one inside the other; bodies may touch."""
    for first, second in combinations(points, 2):
        hits = [*_hits(scene, points[first].world, second), *_hits(scene, points[second].world, first)]
        if hits:
            place = ", ".join(f"{c:.6g}" for c in hits[0])
            message = f"overlaps the body '{first}' in {len(hits)} particles, such as at ({place}) m"
            yield _problem(scene, _placement_path(scene, second), f"{message}; move one of them")


def _hits(scene: Scene, x: Array, body: str) -> Array:
    """Return the points inside a body's shape."""
    shape = scene.bodies[body].whole()
    lower, upper = shape.bounds()
    near = x[np.all((x >= lower) & (x <= upper), axis=1)]
    return near[shape.inside(near)] if len(near) else near


def _placement_path(scene: Scene, body: str, piece: int | None = None) -> str:
    """Return the path of what gives the position of a body, or of one of its pieces, by its number."""
    spec = scene.bodies[body]
    if piece is not None and spec.parts:
        return f"bodies.{body}.{list(spec.pieces)[piece]}"
    return f"bodies.{body}." + ("place" if spec.place else "shape" if spec.shape else "parts")


def overlapping_parts(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield a problem for each pair of parts that overlap: filled separately, they would fill space twice."""
    for name, body in scene.bodies.items():
        place, particles = body.place or Place(), points[name]
        x = [place.to_local(particles.world[particles.piece == k]) for k in range(len(body.pieces))]
        for (i, (path_i, a)), (j, (path_j, b)) in combinations(enumerate(body.pieces.items()), 2):
            share = max(_overlap(a, b), _overlap(b, a), _filled_twice(x[i], a, b), _filled_twice(x[j], a, b))
            if share > 0:
                message = (
                    f"overlaps the part '{path_i.partition('.')[2]}', in about {share:.1%} of the smaller: parts are "
                    "filled separately; move one, cut it out with a `difference`, or make one part a `union` of both"
                )
                yield _problem(scene, f"bodies.{name}.{path_j}", message)


def _overlap(shape: Shape, other: Shape) -> float:
    """Return the part of a shape that lies in another shape, estimated with a few points: 0 to 1."""
    lower, upper = finite_bounds(shape)
    low, high = other.bounds()
    if (high <= lower).any() or (low >= upper).any():
        return 0.0
    x = cell_centres(lower, (upper - lower) / PROBES, np.full(len(lower), PROBES))
    inside = shape.inside(x)
    return float((inside & other.inside(x)).sum() / max(1, inside.sum()))


def _filled_twice(x: Array, shape: Shape, other: Shape) -> float:
    """Return the part of the particles at x (n, D) that lie inside both shapes, not on a face of either: 0 to 1."""
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
    """Yield a problem for each group, or region of something that acts on particles, without a particle of its body."""
    for body, spec in scene.bodies.items():
        for name in spec.material_of:
            yield from _empty(scene, f"bodies.{body}.material_of.{name}", name, {body: points[body]})
        for group in (*spec.colours, *spec.groups):
            path = f"bodies.{body}.groups.{group}" if group in spec.groups else _placement_path(scene, body)
            what = "holds" if group in spec.groups else f"the colour '{group}' holds"
            yield from _empty(scene, path, group, {body: points[body]}, what)
    for found in marked(scene, Choice):
        if is_chamber(found.part):  # no particle is in a cavity
            continue
        if isinstance(found.value.value, Region) and marked_fields(type(found.part), NamesBody):
            owner = body_of(found.part)
            held = {owner: points[owner]} if owner is not None else points
            yield from _empty(scene, joined(found.loc), found.value, held)


def _empty(
    scene: Scene, path: str, region: Chosen[Region] | str, points: Points, what: str = "holds"
) -> Iterator[Problem]:
    filled = {name: body.world for name, body in points.items() if len(body.world)}
    try:
        holds_any = any(points[name].pick(region).any() for name in filled)
    except UsageError as error:
        yield _problem(scene, path, str(error))
        return
    if filled and not holds_any:  # a body without particles has its own problem
        named = isinstance(region, str)  # a group of the body, in the coordinates of its shape
        extents = [
            f"'{name}' lies within {_corner(x.min(axis=0))} to {_corner(x.max(axis=0))} m{where}"
            for name in filled
            for x, where in [_as_described(scene, points, name) if named else (filled[name], "")]
        ]
        yield _problem(scene, path, f"{what} no particle: {', '.join(extents)}")


def _as_described(scene: Scene, points: Points, body: str) -> tuple[Array, str]:
    """Return a body's particles in the coordinates of its shape, and words that say so."""
    return points[body].local, " before it is placed" if scene.bodies[body].place is not None else ""


def _corner(x: Array) -> str:
    return "(" + ", ".join(f"{c:.6g}" for c in x) + ")"


def sparse_bodies(scene: Scene, volumes: Mapping[str, Array]) -> list[Problem]:
    """Return warnings for bodies with fewer than two particles per cell along each axis.

    Args:
        scene: the scene.
        volumes: particle volumes (N,) [m^3; 2D: m^2] by body, before any `unit_mass`.
    """
    needed, warnings = 2**scene.dim, []
    for name, volume in volumes.items():
        if not len(volume):
            continue
        in_cell = scene.world.dx**scene.dim / float(volume.mean())
        if in_cell < needed * (1 - 1e-9):
            message = (
                f"{in_cell:.3g} particles in a cell are few: with fewer than {needed} (two along each axis) a body "
                "may break apart when it stretches"
            )
            key = "sampling" if scene.bodies[name].particles_per_cell is None else "particles_per_cell"
            key = "spacing" if scene.bodies[name].spacing is not None else key
            warnings.append(_problem(scene, f"bodies.{name}.{key}", message))
    return warnings


def volume_errors(scene: Scene, points: Points, volumes: Mapping[str, Array]) -> Iterator[Problem]:
    """Yield warnings for pieces whose particles have another volume, and so another mass, than their shapes.

    A lattice counts whole cells. If a shape fills its bounds, like a box, whole rows are too many or too few. In a
    round shape each cell at the surface counts by chance, so with few particles an error cannot be avoided.

    Args:
        scene: the scene.
        points: particles by body.
        volumes: particle volumes (N,) [m^3; 2D: m^2] by body, before any `unit_mass`, which needs none.
    """
    for name, body in scene.bodies.items():
        scale = (body.place or Place()).scale
        spacing, per_cell = body.particle_spacing(scene.world.dx), body.particles_per_cell
        for k, (path, shape) in enumerate(body.pieces.items()) if not body.unit_mass else ():
            particle_volumes = volumes[name][points[name].piece == k]
            lower, upper = finite_bounds(shape)
            known = type(shape).volume is not Shape.volume
            volume = shape.volume() if known else counted_volume(shape, _MEASURING_CELLS)
            chance = 0.0 if volume > 0.999 * np.prod(upper - lower) else _chance(len(particle_volumes), scene.dim)
            expected = scale**scene.dim * volume
            if abs(particle_volumes.sum() / expected - 1) > max(VOLUME_ERROR, chance) * (1 + 1e-9):
                unit = "m^2" if scene.dim == 2 else "m^3"
                message = (
                    f"its particles have a volume of {particle_volumes.sum():.4g} {unit}, which differs by "
                    f"{particle_volumes.sum() / expected - 1:+.1%} from the {expected:.4g} {unit} of the shape, and so "
                    "does its mass: "
                )
                yield _problem(
                    scene, f"bodies.{name}.{path}", message + _volume_advice(scale * (upper - lower), spacing, per_cell)
                )


def _chance(count: int, dim: int) -> float:
    """Return the relative volume error that a lattice of `count` cells may have in a round shape.

    About 2 D n^(1 - 1/D) of its n cells are at the surface.
    """
    at_surface = 2 * dim * max(1, count) ** (1 - 1 / dim)
    return N_DEVIATIONS * float(np.sqrt(at_surface / 12)) / max(1, count)


def _volume_advice(size: Array, spacing: float | None, per_cell: float | None) -> str:
    """Return how to make particles fill a shape of a size (D,) [m], so many of which are in a cell."""
    if spacing is None:
        return "give another count, or `sampling: {random: {count: ...}}`, whose particles share the shape's volume"
    rows = size / spacing
    odd = [f"{size[k]:.6g} m along {'xyz'[k]}" for k in np.flatnonzero(np.abs(rows - np.round(rows)) > FLOAT32 * rows)]
    if not odd:
        return f"give a smaller spacing, or {_FITTED}, whose particles have the shape's volume"
    return (
        f"{' and '.join(odd)} {'is not a multiple' if len(odd) == 1 else 'are not multiples'} of the spacing of "
        f"{spacing:.6g} m; give a size that is one, {_other_spacing(size, spacing, per_cell)}, or "
        f"{_FITTED}"
    )


def _other_spacing(size: Array, spacing: float, per_cell: float | None) -> str:
    """Return which spacing, or which dx, makes edges (D,) whole numbers of particles."""
    cell = 1.0 if per_cell is None else per_cell ** (1 / len(size))
    whole = whole_spacing(size, spacing, cell)
    if whole is None:
        return "another spacing"
    return f"a spacing of {whole:.6g} m" if per_cell is None else f"a dx of {cell * whole:.6g} m"


def walls_outside(scene: Scene) -> Iterator[Problem]:
    """Yield warnings for walls that are outside the world, because no row of nodes is at the far face of an axis."""
    dx = scene.world.dx
    for axis, size in enumerate(scene.world.size):
        letter, cells = "xyz"[axis], max(1, round(size / dx))
        for name, chosen in scene.boundaries.items():
            spec = chosen.value
            if not isinstance(spec, BoundaryCondition) or spec.face not in (f"{letter}_max", "all"):
                continue
            wall = dx * np.ceil((size * (1 - ROUNDING) - spec.thickness) / dx)
            if wall > size * (1 + ROUNDING):
                message = (
                    f"{size:.6g} m along {letter} is not a multiple of dx = {dx:.6g} m, so the wall '{name}' begins at "
                    f"{wall:.6g} m, {wall - size:.3g} m outside the world; give dx = {size / cells:.6g} m, or a "
                    f"size of {cells * dx:.6g} m"
                )
                yield _problem(scene, f"world.size.{axis}", message)
                break


def planes_between_nodes(scene: Scene) -> Iterator[Problem]:
    """Yield warnings for half-spaces across an axis whose plane is not on a row of nodes: they begin behind it."""
    dx = scene.world.dx
    for name, chosen in scene.boundaries.items():
        region = boundary(scene, name).region
        shape = None if region is None else region.value
        if not isinstance(shape, HalfSpace) or len(across := np.flatnonzero(shape.normal)) != 1:
            continue
        axis = int(across[0])
        outward, place = float(np.sign(shape.normal[axis])), shape.point[axis]
        row = outward * place / dx
        if abs(row - round(row)) > ROUNDING * max(1.0, abs(row)):
            inner, outer = (outward * dx * side + 0.0 for side in (np.floor(row), np.ceil(row)))
            message = (
                f"its plane at {'xyz'[axis]} = {place:.6g} m lies between two rows of nodes: the held nodes begin at "
                f"{inner:.6g} m, {abs(place - inner):.3g} m behind it; put it at {inner:.6g} or {outer:.6g} m, or give "
                f"a dx of which {place:.6g} m is a multiple"
            )
            yield _problem(scene, f"boundaries.{name}.{chosen.name}.region", message)


def points_to_track(scene: Scene, points: Points) -> Iterator[Problem]:
    """Yield a problem for each point that synthetic data would track, but that is not on the body."""
    synthetic = scene.synthetic
    if synthetic is None or not len(points[synthetic.body].world):
        return
    x = points[synthetic.body].world
    if (synthetic.tracked or 0) > len(x):
        message = f"tracks {synthetic.tracked:,} particles, but the body '{synthetic.body}' has only {len(x):,}"
        yield _problem(scene, "data.synthetic.tracked", message)
    extent = float(np.linalg.norm(x.max(axis=0) - x.min(axis=0)))
    for name, place in (synthetic.markers or {}).items():
        distance = float(np.linalg.norm(x - np.array(place), axis=1).min())
        if distance > extent:
            message = (
                f"is {distance:.3g} m from the body '{synthetic.body}', which is {extent:.3g} m across: give its rest "
                "position in the coordinates of the scene, in metres"
            )
            yield _problem(scene, joined(("data", "synthetic", "markers", name)), message)


def _problem(scene: Scene, path: str, message: str) -> Problem:
    return Problem(scene.where(path), path, message)
