"""The boundaries whose force and moment in motion are recorded, and the points about which moments are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from cqrun.build.particles import Particles
from cqrun.build.rigid import parts_of
from cqrun.engine.model import ConditionModel
from cqrun.engine.reference.held import held_at
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene


def boundaries_by_user(scene: Scene) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each term, measured quantity and recording that needs boundaries: its key path, and their names."""
    users: dict[str, Any] = {f"objective.{name}.{c.name}": c.value for name, c in scene.objective.items()}
    users |= {f"constraints.{name}.of.{c.of.name}": c.of.value for name, c in scene.constraints.items()}
    for name, recording in scene.recordings.items():
        users[f"data.recordings.{name}.{recording.measurement.name}"] = recording.measurement
    users |= {f"measure.{name}.{c.name}": c.value for name, c in scene.measure.items()}
    for path, user in users.items():
        if user.boundaries:
            yield path, user.boundaries


def needed_boundaries(scene: Scene) -> tuple[str, ...]:
    """Return the boundaries that terms and recordings need, in the order of the scene."""
    needed = {name for _, names in boundaries_by_user(scene) for name in names}
    return tuple(name for name in (*scene.boundaries, *scene.rigid) if name in needed)


def centers(scene: Scene, particles: Particles, conditions: Sequence[ConditionModel]) -> dict[str, Array]:
    """Return the point of each boundary that holds nodes (D,) [m], by name: its `center`, or that of what it holds.

    The latter is the centroid of the particles inside the boundary at the scene's values. It does not depend on the
    grid, as the mean of the held nodes does, and does not move with an unknown shape. A boundary without particles
    inside, such as a plane on the face of a body, has no such point.
    """
    found = {}
    for name in dict.fromkeys(plane.name for plane in conditions):
        planes = [plane for plane in conditions if plane.name == name]
        given, to = (getattr(planes[0].spec, field, None) for field in ("center", "to"))
        if to in scene.rigid:  # it turns about the centre of the rigid body that carries it
            given = parts_of(scene, particles)[to].center[: scene.dim]
        inside = held_at(planes, particles.x, np.array(scene.world.size)).bits != 0
        weight = (particles.volume * particles.room)[inside]
        if given is not None:
            found[name] = np.array(given, float)
        elif inside.any():
            found[name] = weight @ particles.x[inside] / weight.sum()
    return found
