"""The planes of all boundaries of a scene."""

from __future__ import annotations

from typing import Any

import numpy as np

from cqrun.build.regions import boundary
from cqrun.engine.model import ConditionModel, conditions_of
from cqrun.errors import Problem, SceneError
from cqrun.scene.schema import Scene


def all_conditions(scene: Scene) -> tuple[ConditionModel, ...]:
    """Return the planes of all boundaries on the world's grid.

    Raises:
        SceneError: in the updated frame, a boundary holds no node; or there are too many planes.
    """
    conditions: list[ConditionModel] = []
    for name, chosen in scene.boundaries.items():
        spec: Any = boundary(scene, name)
        planes = conditions_of(name, spec, np.array(scene.world.size), scene.world.dx)
        if scene.world.frame != "reference" and not any(plane.nodes.any() for plane in planes):
            path = f"boundaries.{name}.{chosen.name}.region"
            message = f"holds no grid node: it is thinner than a cell of {scene.world.dx:g} m, or outside the world"
            raise SceneError([Problem(scene.where(path), path, message)])
        conditions += planes
    if len(conditions) > 60:
        message = f"there are {len(conditions)} planes of boundaries, but at most 60 are possible: join some"
        raise SceneError([Problem(scene.where("boundaries"), "boundaries", message)])
    return tuple(conditions)
