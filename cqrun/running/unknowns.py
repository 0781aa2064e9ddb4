"""Turn the unknowns of a scene, with the values tied to them, into blocks of one vector (`design/params.py`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.build.particles import Particles
from cqrun.design import spread
from cqrun.design.params import Block, Follower, Params, Spread
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.explain import listed
from cqrun.plugin.contract import Array
from cqrun.scene.data import Unknown
from cqrun.scene.paths import canonical
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import body_of, start
from cqrun.store.result import Value

RESOLUTION = 4
"""Number of cells of a field along the longest edge of its body, if the unknown gives no resolution."""


def make_params(built: Built) -> Params:
    """Return the parameters of a scene: its unknowns at their start values."""
    return Params(blocks_of(built.scene, built.particles))


def blocks_of(scene: Scene, particles: Particles) -> tuple[Block, ...]:
    """Return the unknowns of a scene as blocks at their start values; raise a SceneError if bodies do not match."""
    return tuple(_block(scene, particles, path, unknown) for path, unknown in scene.unknowns.items())


def values_found(scene: Scene, particles: Particles, found: Mapping[str, Value]) -> dict[str, Array]:
    """Return the values of the unknowns in a result, and of the values tied to them, by path.

    Args:
        found: by path, as `values_in` has them.
    """
    values = {path: np.array(value, float) for path, value in found.items()}
    blocks = [block for block in blocks_of(scene, particles) if block.path in values]
    return values | {f.path: f.of(values[b.path]) for b in blocks for f in b.followers}


def _block(scene: Scene, particles: Particles, path: str, unknown: Unknown) -> Block:
    """Return an unknown as a block at its start value; raise a SceneError if a body is not its own mirror image."""
    name, initial = canonical(scene, path), start(scene, path)
    low, high, log = *unknown.bounds, unknown.scale == "log"
    body, followers = body_of(scene, name), tuple(_followers(scene, particles, path, unknown))
    further: Any = {"followers": followers, "regulariser": unknown.regulariser}
    if unknown.per == "body":
        return Block(name, low, high, log, np.array(initial), **further)
    x = particles.x[particles.of(body)]
    values = np.full(len(scene.bodies[body].group_names) if unknown.per == "group" else len(x), initial)
    axis = -1 if unknown.mirror is None else "xyz".index(unknown.mirror)
    if unknown.per != "field" and unknown.mirror is None:
        return Block(name, low, high, log, values, **further)
    if unknown.per != "field":
        try:
            partner = spread.partners(x, axis, f"particles of '{body}'")
            if unknown.per == "group":
                partner = spread.group_partners(particles.points[body].groups, partner, axis, f"'{body}'")
            return Spread(name, low, high, log, values, spread.pairs(partner), **further)
        except UsageError as error:
            place = f"unknowns.{path}.mirror"
            raise SceneError([Problem(scene.where(place), place, str(error))]) from error
    cells = unknown.resolution or RESOLUTION
    over = spread.field(x, cells) if unknown.mirror is None else spread.mirrored_field(x, cells, axis)
    return Spread(name, low, high, log, values, over, **further)


def _followers(scene: Scene, particles: Particles, path: str, unknown: Unknown) -> Iterator[Follower]:
    """Yield the values tied to an unknown; raise a SceneError if two bodies do not match."""
    name = canonical(scene, path)
    for other, tie in unknown.also.items():
        same, order = canonical(scene, other), None
        if unknown.per != "body":
            try:
                order = _matched(scene, particles, body_of(scene, name), body_of(scene, same), unknown.per)
            except UsageError as error:
                place = f"unknowns.{path}.also.{other}"
                raise SceneError([Problem(scene.where(place), place, str(error))]) from error
        yield Follower(same, tie.factor, tie.offset, order)


def _matched(scene: Scene, particles: Particles, body: str, other: str, per: str) -> Array | None:
    """Return, for each group or particle of `other`, the index of the one of `body` that it corresponds to."""
    if per == "group":
        ours, theirs = scene.bodies[body].group_names, scene.bodies[other].group_names
        if sorted(ours) != sorted(theirs):
            raise UsageError(f"'{other}' has the groups {listed(theirs)}, '{body}' has {listed(ours)}: they must match")
        return np.array([ours.index(name) for name in theirs])
    x, y = (particles.x[particles.of(name)] for name in (body, other))
    return spread.shifted(x, y, f"particles of '{other}'", f"of '{body}'")
