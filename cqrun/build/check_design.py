"""What the bounds of geometric unknowns allow: that at none of them a body is where, or as thin as, it cannot be."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cqrun.plugin.contract import Array
from cqrun.design.spread import mirrored
from cqrun.errors import MissingExtra, Problem, SceneError, UsageError
from cqrun.build.check_particles import outside_world, overlapping_bodies, overlapping_parts
from cqrun.build.rest_shape import Geometry
from cqrun.build.particles import Particles
from cqrun.scene.paths import canonical, cuts, leaf, shapes_a_body, with_values
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import body_of, start, tied

ROUNDING = 1e-6
FEW, MANY = 3, 16
"""Unknowns of geometry of which all combinations of bounds and start are tried; of which all pairs are, of bounds."""

AT_RANDOM = 32
"""Combinations of bounds that are tried beside where there are more than a few unknowns."""

TURN = 30.0
"""Degrees between two angles that are tried: a body that turns reaches furthest between its bounds."""

CRUSHED = 1e-4
"""Part of its volume at the start below which nothing is left of a particle."""

STRIDES = 64
"""Values between its bounds at most of an unknown that carries a body past others: it might meet them in between."""

LOPSIDED = 0.1
"""Part of a body whose mirror image lies outside it, from which on a mirrored field is not what one thinks."""

NEIGHBOURS = 6
"""Of a particle, whose distances tell how far apart a body's particles have come."""

Ends = Mapping[str, float]


def design_problems(scene: Scene, particles: Particles) -> list[Problem]:
    """Return what is wrong with geometric unknowns and their bounds.

    Each bound is tried alone, then values between them, where a body turns or might meet another, then bounds together.
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
        path = next((path for path in unknowns if not _starts(scene, particles, path)), next(iter(unknowns)))
        return [Problem(scene.where(f"unknowns.{path}"), f"unknowns.{path}", str(error))]
    found = list(_tried(rest, [{path: end} for path, unknown in unknowns.items() for end in unknown.bounds]))
    for path in unknowns if not found else ():
        found += _tried(rest, [{path: value} for value in _between(rest, path)], most=1)
    return found or list(_tried(rest, _together(scene, list(unknowns)), most=1))


def design_warnings(scene: Scene, particles: Particles) -> list[Problem]:
    """Return what a user may not expect of unknowns: particles that they do not reach, values that they replace."""
    found = []
    for path, unknown in scene.unknowns.items():
        told = f"unknowns.{path}"
        if unknown.per == "group":
            found += [Problem(scene.where(told), told, message) for message in _ungrouped(scene, particles, path)]
        if unknown.per == "field" and unknown.mirror is not None:
            messages = _lopsided(scene, particles, path, unknown.mirror)
            found += [Problem(scene.where(told), f"{told}.mirror", message) for message in messages]
        found += [Problem(scene.where(told), told, message) for message in _cut(scene, path)]
        for other, value in list(tied(scene, path, start(scene, path)).items())[1:]:
            own = leaf(scene, other).value
            if differ(value, own):
                message = f"{other} starts at {value:g}, by `also`, and not at the {own:g} that the scene has there"
                found.append(Problem(scene.where(told), told, message))
    return found


def _cut(scene: Scene, path: str) -> Iterator[str]:
    """Yield that what cuts a shape does not stay where it is."""
    through = {name for p in _geometric(scene, path, start(scene, path)) for name, _ in cuts(canonical(scene, p))}
    if through:
        names = " or ".join(f"{'a' if name == 'difference' else 'an'} {name}" for name in sorted(through))
        yield f"changes the first shape of {names}: what cuts it moves and stretches with it, and does not stay"


def differ(value: float, own: float) -> bool:
    """Say whether two values differ by more than rounding, as of a sum of two numbers."""
    return abs(value - own) > ROUNDING * max(abs(value), abs(own))


def _starts(scene: Scene, particles: Particles, path: str) -> bool:
    """Say whether particles can follow an unknown of geometry from its start."""
    values = {canonical(scene, p): np.array(v) for p, v in _geometric(scene, path, start(scene, path)).items()}
    try:
        Geometry(scene, particles).at_rest(values)
    except UsageError:
        return False
    return True


def _ungrouped(scene: Scene, particles: Particles, path: str) -> Iterator[str]:
    body = body_of(scene, canonical(scene, path))
    held = np.sum([points for points in particles.points[body].groups.values()], axis=0)
    if (held == 0).any():
        yield f"{(held == 0).sum():,} of {held.size:,} particles of '{body}' are in no group: theirs stays as it is"
    if (held > 1).any():
        yield f"{(held > 1).sum():,} particles of '{body}' are in several groups, and have the value of the last"


def _lopsided(scene: Scene, particles: Particles, path: str, mirror: str) -> Iterator[str]:
    body = body_of(scene, canonical(scene, path))
    image = mirrored(particles.points[body].world, "xyz".index(mirror))
    outside = np.mean(~scene.bodies[body].whole().inside(image))
    if outside > LOPSIDED:
        yield (
            f"'{body}' is not its own mirror image across {mirror}, in {outside:.0%} of its particles: their values "
            "follow those of places where it is not"
        )


def _between(rest: _Rest, path: str) -> Array:
    """Return the values between its bounds of an unknown that are tried while the others are at their starts."""
    lower, upper = rest.scene.unknowns[path].bounds
    turns = max(2, int(np.ceil((upper - lower) / TURN))) if leaf(rest.scene, path).unit == "deg" else 1
    return np.linspace(lower, upper, 1 + max(turns, rest.strides(path)))[1:-1]


def _together(scene: Scene, paths: Sequence[str]) -> Iterator[Ends]:
    """Yield bounds of several unknowns at once."""
    bounds = {path: scene.unknowns[path].bounds for path in paths}
    if 1 < len(paths) <= FEW:
        for ends in itertools.product(*[(low, start(scene, path), high) for path, (low, high) in bounds.items()]):
            yield dict(zip(paths, ends, strict=True))
    elif len(paths) > FEW:
        yield from ({path: ends[side] for path, ends in bounds.items()} for side in (0, 1))
        for one, other in itertools.combinations(paths, 2) if len(paths) <= MANY else ():
            yield from ({one: a, other: b} for a in bounds[one] for b in bounds[other])
        for sides in np.random.default_rng(0).integers(0, 2, (AT_RANDOM, len(paths))):
            yield {path: bounds[path][side] for path, side in zip(paths, sides, strict=True)}


def _tried(rest: _Rest, trials: Iterable[Ends], most: int | None = None) -> Iterator[Problem]:
    """Yield what is wrong at trials, values of unknowns by path, under the first of them; at `most` so many."""
    scene = rest.scene
    for ends in trials:
        told = f"unknowns.{next(iter(ends))}.bounds"
        values = {p: v for path, end in ends.items() for p, v in _geometric(scene, path, end).items()}
        for message in rest.wrong_at(values):
            yield Problem(scene.where(told), told, f"{_words(ends)} {message}; narrow the bounds")
            if most is not None and (most := most - 1) == 0:
                return
            break  # the first says enough: one bound often breaks several rules


def _is_geometric(scene: Scene, path: str) -> bool:
    return shapes_a_body(canonical(scene, path))


def _geometric(scene: Scene, path: str, value: float) -> dict[str, float]:
    """Return the values of an unknown and its followers that shape or place a body."""
    return {p: v for p, v in tied(scene, path, value).items() if _is_geometric(scene, p)}


def _words(ends: Mapping[str, float]) -> str:
    if len(ends) == 1:
        return f"at {next(iter(ends.values())):g}"
    if len(ends) <= FEW:
        return "with " + " and ".join(f"{path} at {end:g}" for path, end in ends.items())
    return "with all geometric unknowns at " + ", ".join(f"{end:g}" for end in ends.values())


class _Rest:
    """A scene at rest, as its geometric unknowns change.

    Args:
        starts: where these and what follows them start, by path.
    """

    def __init__(self, scene: Scene, particles: Particles, starts: Ends) -> None:
        self.scene, self.particles, self.starts = scene, particles, starts
        self._geometry = Geometry(scene, particles)
        self._near = {name: _neighbours(particles.x[particles.of(name)]) for name in particles.names}
        before, self._volume = self._at(starts)
        self._apart = {name: self._spread(name, before) for name in particles.names}

    def wrong_at(self, values: Ends) -> Iterator[str]:
        """Yield what is wrong at some values, the others at their starts."""
        scene, particles, values = self.scene, self.particles, {**self.starts, **values}
        try:
            changed = with_values(scene, values)
        except SceneError as error:
            yield f"the scene is none: {error.problems[0].path} {error.problems[0].message}"
            return
        x, volume = self._at(values)
        if (volume <= 0).any():
            yield "a part of a body is turned inside out"
            return
        if (volume < CRUSHED * self._volume).any():
            yield f"a part of a body has less than {CRUSHED:g} of the volume that it has at the start"
            return
        points = {name: replace(body, world=x[particles.of(name)]) for name, body in particles.points.items()}
        problems = [
            *outside_world(changed, points),
            *overlapping_bodies(changed, points),
            *overlapping_parts(changed, points),
        ]
        yield from (f"{problem.path} {problem.message}" for problem in problems)
        yield from (message for name in particles.names for message in self._sparse(name, x))

    def strides(self, path: str) -> int:
        """Return in how many steps an unknown goes from bound to bound so that none passes over a body or a part."""
        boxes = [shape.bounds() for body in self.scene.bodies.values() for shape in body.pieces.values()]
        if len(boxes) == 1:
            return 1
        bounds = self.scene.unknowns[path].bounds
        x, there = (self._at({**self.starts, **_geometric(self.scene, path, end)})[0] for end in bounds)
        far, thin = np.linalg.norm(there - x, axis=1).max(), min((upper - lower).min() for lower, upper in boxes)
        return int(np.clip(np.ceil(2.0 * far / thin), 1, STRIDES))

    def _at(self, values: Ends) -> tuple[Array, Array]:
        return self._geometry.at_rest({canonical(self.scene, path): np.array(v) for path, v in values.items()})

    def _sparse(self, body: str, x: Array) -> Iterator[str]:
        """Yield that a body's particles come further apart than half a cell, and further than they are at the start."""
        dx, apart = self.scene.world.dx, self._spread(body, x)
        if apart > max(0.5 * dx * (1 + ROUNDING), self._apart[body] * (1 + ROUNDING)):
            yield (
                f"bodies.{body} has particles {apart:.4g} m apart, fewer than two in a cell's {dx:g} m, so it may "
                "break: give it more particles"
            )

    def _spread(self, body: str, x: Array) -> float:
        """Return how far a body's particles are apart, where neighbours have come apart most [m]."""
        near, distance = self._near[body]
        own = x[self.particles.of(body)]
        apart = np.linalg.norm(own[near] - own[:, None], axis=2)
        return self.particles.spacing[body] * max(1.0, float((apart / distance).max(initial=0.0)))


def _neighbours(x: Array) -> tuple[Array, Array]:
    """Return the nearest neighbours (n, k) of points x (n, D), and how far they are (n, k) [m]."""
    from scipy.spatial import cKDTree

    count = min(NEIGHBOURS, len(x) - 1)
    if count < 1:
        return np.zeros((len(x), 0), int), np.ones((len(x), 0))
    distance, near = cKDTree(x).query(x, k=count + 1)
    return near[:, 1:], distance[:, 1:]
