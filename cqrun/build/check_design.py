"""Check the bounds of geometric unknowns: no body may leave the world, overlap another or become too thin."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cqrun.build.check_particles import outside_world, overlapping_bodies, overlapping_parts
from cqrun.build.particles import Particles
from cqrun.build.rest_shape import Geometry
from cqrun.design.spread import mirrored
from cqrun.errors import MissingExtra, Problem, SceneError, UsageError
from cqrun.plugin.contract import Array
from cqrun.scene.paths import canonical, cuts, leaf, shapes_a_body, with_values
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import body_of, start, tied

ROUNDING = 1e-6
FEW, MANY = 3, 16
"""Up to FEW geometric unknowns, all combinations of bounds and start are tried; up to MANY, all pairs of bounds."""

N_RANDOM = 32
"""Number of random combinations of bounds that are also tried if there are more than FEW unknowns."""

TURN = 30.0
"""Step between angles that are tried [degrees]; a turning body may reach furthest between its bounds."""

CRUSHED = 1e-4
"""Smallest allowed volume of a particle, as a part of its volume at the start."""

MOST_STEPS = 64
"""Largest number of steps between the bounds of an unknown that moves a body, which might meet others in between."""

ASYMMETRIC = 0.1
"""If the mirror image of more than this part of a body lies outside it, a mirrored field gets a warning."""

NEIGHBOURS = 6
"""Number of neighbours of a particle whose distances are compared to find how far particles have moved apart."""

TOUCHING = 1.3
"""Pieces of a body touch if their particles are nearer than this many spacings: across a corner alone it is 1.41."""

Ends = Mapping[str, float]


def design_problems(scene: Scene, particles: Particles) -> list[Problem]:
    """Return what is wrong with geometric unknowns and their bounds.

    First each bound is tried alone, then values between the bounds if a body turns or might meet another body, and then
    combinations of bounds.
    """
    unknowns = {path: unknown for path, unknown in scene.unknowns.items() if _geometric(scene, path, 0.0)}
    if not unknowns:
        return []
    starts = {p: v for path in unknowns for p, v in _geometric(scene, path, start(scene, path)).items()}
    try:
        rest = _Rest(scene, particles, starts)
    except MissingExtra:
        raise
    except UsageError as error:
        path = next((path for path in unknowns if not _can_start(scene, particles, path)), next(iter(unknowns)))
        return [Problem(scene.where(f"unknowns.{path}"), f"unknowns.{path}", str(error))]
    problems = list(_problems_at(rest, [{path: end} for path, unknown in unknowns.items() for end in unknown.bounds]))
    for path in unknowns if not problems else ():
        problems += _problems_at(rest, [{path: value} for value in _values_between(rest, path)], most=1)
    return problems or list(_problems_at(rest, _combinations(scene, list(unknowns)), most=1))


def design_warnings(scene: Scene, particles: Particles) -> list[Problem]:
    """Return warnings about unknowns: particles that they do not reach, and values of the scene that they replace."""
    warnings = []
    for path, unknown in scene.unknowns.items():
        key = f"unknowns.{path}"
        if unknown.per == "group":
            warnings += [Problem(scene.where(key), key, message) for message in _ungrouped(scene, particles, path)]
        if unknown.per == "field" and unknown.mirror is not None:
            messages = _asymmetric(scene, particles, path, unknown.mirror)
            warnings += [Problem(scene.where(key), f"{key}.mirror", message) for message in messages]
        warnings += [Problem(scene.where(key), key, message) for message in _cut(scene, path)]
        for other, value in list(tied(scene, path, start(scene, path)).items())[1:]:
            in_scene = leaf(scene, other).value
            if differ(value, in_scene):
                message = (
                    f"{other} starts at {value:g}, because of `also`, and not at its value {in_scene:g} in the scene"
                )
                warnings.append(Problem(scene.where(key), key, message))
    return warnings


def _cut(scene: Scene, path: str) -> Iterator[str]:
    """Yield a warning if the unknown changes a shape that is cut by others, because they follow it."""
    through = {name for p in _geometric(scene, path, start(scene, path)) for name, _ in cuts(canonical(scene, p))}
    if through:
        names = " or ".join(f"{'a' if name == 'difference' else 'an'} {name}" for name in sorted(through))
        yield f"changes the first shape of {names}: the shapes that cut it move and stretch with it"


def differ(value: float, other: float) -> bool:
    """Return whether two values differ by more than the rounding of a sum of two numbers."""
    return abs(value - other) > ROUNDING * max(abs(value), abs(other))


def _can_start(scene: Scene, particles: Particles, path: str) -> bool:
    """Return whether particles can follow a geometric unknown to its start value."""
    values = {canonical(scene, p): np.array(v) for p, v in _geometric(scene, path, start(scene, path)).items()}
    try:
        Geometry(scene, particles).at_rest(values)
    except UsageError:
        return False
    return True


def _ungrouped(scene: Scene, particles: Particles, path: str) -> Iterator[str]:
    body = body_of(scene, canonical(scene, path))
    count = np.sum([points for points in particles.points[body].groups.values()], axis=0)
    if (count == 0).any():
        lost = (count == 0).sum()
        yield f"{lost:,} of {count.size:,} particles of '{body}' are in no group: their values do not change"
    if (count > 1).any():
        yield f"{(count > 1).sum():,} particles of '{body}' are in several groups, and have the value of the last"


def _asymmetric(scene: Scene, particles: Particles, path: str, mirror: str) -> Iterator[str]:
    body = body_of(scene, canonical(scene, path))
    image = mirrored(particles.points[body].world, "xyz".index(mirror))
    outside = np.mean(~scene.bodies[body].whole().inside(image))
    if outside > ASYMMETRIC:
        yield (
            f"'{body}' is not its own mirror image across {mirror}: the mirror images of {outside:.0%} of its "
            "particles lie outside it, so the values of these particles follow places without material"
        )


def _values_between(rest: _Rest, path: str) -> Array:
    """Return the values between the bounds of an unknown that are tried while the others are at their starts."""
    lower, upper = rest.scene.unknowns[path].bounds
    turns = max(2, int(np.ceil((upper - lower) / TURN))) if leaf(rest.scene, path).unit == "deg" else 1
    return np.linspace(lower, upper, 1 + max(turns, rest.steps(path)))[1:-1]


def _combinations(scene: Scene, paths: Sequence[str]) -> Iterator[Ends]:
    """Yield combinations of the bounds of several unknowns."""
    bounds = {path: scene.unknowns[path].bounds for path in paths}
    if 1 < len(paths) <= FEW:
        for ends in itertools.product(*[(low, start(scene, path), high) for path, (low, high) in bounds.items()]):
            yield dict(zip(paths, ends, strict=True))
    elif len(paths) > FEW:
        yield from ({path: ends[side] for path, ends in bounds.items()} for side in (0, 1))
        for first, second in itertools.combinations(paths, 2) if len(paths) <= MANY else ():
            yield from ({first: a, second: b} for a in bounds[first] for b in bounds[second])
        for sides in np.random.default_rng(0).integers(0, 2, (N_RANDOM, len(paths))):
            yield {path: bounds[path][side] for path, side in zip(paths, sides, strict=True)}


def _problems_at(rest: _Rest, trials: Iterable[Ends], most: int | None = None) -> Iterator[Problem]:
    """Yield the first problem of each trial (values of unknowns by path), but at most `most` problems.

    The key path of a problem is that of the trial's first unknown.
    """
    scene = rest.scene
    for ends in trials:
        key = f"unknowns.{next(iter(ends))}.bounds"
        values = {p: v for path, end in ends.items() for p, v in _geometric(scene, path, end).items()}
        for message in rest.problems_at(values):
            yield Problem(scene.where(key), key, f"{_words(ends)} {message}; narrow the bounds")
            if most is not None and (most := most - 1) == 0:
                return
            break  # the first problem is enough: one bound often breaks several rules


def _is_geometric(scene: Scene, path: str) -> bool:
    return shapes_a_body(canonical(scene, path))


def _geometric(scene: Scene, path: str, value: float) -> dict[str, float]:
    """Return those values of an unknown, and of the values tied to it, that shape or place a body."""
    return {p: v for p, v in tied(scene, path, value).items() if _is_geometric(scene, p)}


def _words(ends: Mapping[str, float]) -> str:
    if len(ends) == 1:
        return f"at {next(iter(ends.values())):g}"
    if len(ends) <= FEW:
        return "with " + " and ".join(f"{path} at {end:g}" for path, end in ends.items())
    return "with all geometric unknowns at " + ", ".join(f"{end:g}" for end in ends.values())


class _Rest:
    """A scene at rest as a function of its geometric unknowns.

    Args:
        scene: the scene.
        particles: the particles of the scene.
        starts: start values of the geometric unknowns and of the values tied to them, by path.
    """

    def __init__(self, scene: Scene, particles: Particles, starts: Ends) -> None:
        self.scene, self.particles, self.starts = scene, particles, starts
        self._geometry = Geometry(scene, particles)
        self._pieces = {name: _Pieces(particles, name) for name in particles.names}
        before, self._volume = self._at(starts)
        self._distance = {name: self._pieces[name].largest_distance(before) for name in particles.names}

    def problems_at(self, values: Ends) -> Iterator[str]:
        """Yield what is wrong at some values, with the other unknowns at their starts."""
        scene, particles, values = self.scene, self.particles, {**self.starts, **values}
        try:
            changed = with_values(scene, values)
        except SceneError as error:
            yield f"the scene is not valid: {error.problems[0].path} {error.problems[0].message}"
            return
        x, volume = self._at(values)
        if (volume <= 0).any():
            yield "a part of a body is turned inside out"
            return
        if (volume < CRUSHED * self._volume).any():
            yield f"a part of a body has less than {CRUSHED:g} times its volume at the start"
            return
        points = {name: replace(body, world=x[particles.of(name)]) for name, body in particles.points.items()}
        problems = [
            *outside_world(changed, points),
            *overlapping_bodies(changed, points),
            *overlapping_parts(changed, points),
        ]
        yield from (f"{problem.path} {problem.message}" for problem in problems)
        yield from (message for name in particles.names for message in self._sparse(name, x))

    def steps(self, path: str) -> int:
        """Return the number of steps from bound to bound that are small enough to meet every body or part between."""
        boxes = [shape.bounds() for body in self.scene.bodies.values() for shape in body.pieces.values()]
        if len(boxes) == 1:
            return 1
        bounds = self.scene.unknowns[path].bounds
        x, x_end = (self._at({**self.starts, **_geometric(self.scene, path, end)})[0] for end in bounds)
        far, thin = np.linalg.norm(x_end - x, axis=1).max(), min((upper - lower).min() for lower, upper in boxes)
        return int(np.clip(np.ceil(2.0 * far / thin), 1, MOST_STEPS))

    def _at(self, values: Ends) -> tuple[Array, Array]:
        return self._geometry.at_rest({canonical(self.scene, path): np.array(v) for path, v in values.items()})

    def _sparse(self, body: str, x: Array) -> Iterator[str]:
        """Yield a message if a body's particles are further apart than half a cell, and than at the start."""
        dx, pieces = self.scene.world.dx, self._pieces[body]
        distance = pieces.largest_distance(x)
        risk = "nodes would move without resistance" if self.scene.world.frame == "reference" else "it may break apart"
        if distance > max(0.5 * dx, self._distance[body]) * (1 + ROUNDING):
            yield (
                f"bodies.{body} has particles {distance:.4g} m apart, fewer than two in a cell of {dx:g} m, so {risk}: "
                "give it more particles"
            )
        if len(alone := pieces.alone(x)) > 0:
            paths = list(self.scene.bodies[body].pieces)
            apart = " and ".join(f"bodies.{body}.{paths[k]}" for k in alone)
            yield f"{apart} come{'s' * (len(alone) == 1)} apart from the rest of the body: they no longer touch"


class _Pieces:
    """How near the particles of a body are to each other, in each of its pieces and across them.

    Pieces may slide along each other, such as a wall along a floor, as long as they touch.
    """

    def __init__(self, particles: Particles, body: str) -> None:
        points = particles.points[body]
        self.own, self.spacing = particles.of(body), particles.spacing[body]
        self.members = [np.flatnonzero(points.piece == k) for k in range(points.piece.max() + 1)]
        self.near = [_neighbours(points.world[part]) for part in self.members]
        self.before = self._parts(points.world)

    def largest_distance(self, x: Array) -> float:
        """Return the largest distance between neighbouring particles of a piece [m]."""
        most, x_body = 1.0, x[self.own]
        for part, (near, before) in zip(self.members, self.near, strict=True):
            after = np.linalg.norm(x_body[part][near] - x_body[part][:, None], axis=2)
            most = max(most, float((after / before).max(initial=0.0)))
        return self.spacing * most

    def alone(self, x: Array) -> list[int]:
        """Return the pieces that hang together with others at the start, and no longer with the largest of them."""
        after, lost = self._parts(x[self.own]), []
        for part in np.unique(self.before):
            together = np.flatnonzero(self.before == part)
            largest = max(together, key=lambda k: len(self.members[k]))
            lost += [int(k) for k in together if after[k] != after[largest]]
        return lost

    def _parts(self, x_body: Array) -> Array:
        """Return the number of the part of the body, of pieces that touch, to which each piece belongs."""
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        count = len(self.members)
        pairs = [
            (a, b)
            for a, b in itertools.combinations(range(count), 2)
            if _apart(x_body[self.members[a]], x_body[self.members[b]]) < TOUCHING * self.spacing
        ]
        one, other = np.array(pairs, dtype=int).reshape(-1, 2).T
        graph = coo_array((np.ones(len(pairs)), (one, other)), shape=(count, count))
        return np.asarray(connected_components(graph, directed=False)[1])


def _apart(x: Array, y: Array) -> float:
    """Return the least distance between two sets of points (n, D) and (m, D) [m]."""
    from scipy.spatial import cKDTree

    return float(cKDTree(x).query(y)[0].min())


def _neighbours(x: Array) -> tuple[Array, Array]:
    """Return the nearest neighbours (n, k) of points x (n, D), and their distances (n, k) [m]."""
    from scipy.spatial import cKDTree

    count = min(NEIGHBOURS, len(x) - 1)
    if count < 1:
        return np.zeros((len(x), 0), int), np.ones((len(x), 0))
    distance, near = cKDTree(x).query(x, k=count + 1)
    return near[:, 1:], distance[:, 1:]
