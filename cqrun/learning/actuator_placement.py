"""Check that actuators act on the same particles as in the training of a controller, if bodies were only moved.

Routes and regions have fixed places in the world: if a body is moved for a replay, they do not move with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.engine.model import ActuatorModel
from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.plugin.contract import Array
from cqrun.scene.paths import shapes_a_body

NEAR = 1e-6
"""Distance in cells within which two places are the same."""


def actuator_placement(built: Built) -> dict[str, Any]:
    """Return the centre of each actuator's particles relative to its body, and the bodies' places without offsets."""
    particles, x = built.particles, built.particles.x
    middles = {
        part.name: (_middle(part.model, x) - x[particles.of(part.spec.body)].mean(axis=0)).tolist()
        for part in built.assembly.actuation.parts
    }
    places = {name: body.place for name, body in built.scene.bodies.items()}
    lie = {name: place and place.model_dump(mode="json", exclude={"offset"}) for name, place in places.items()}
    return {"particles": len(x), "lie": lie, "actuators": middles}


def _middle(model: ActuatorModel, x: Array) -> Array:
    """Return the middle of the points that a part acts on (D,) [m], without those that are fixed in the world."""
    return np.asarray(model.at_rest(x)[model.particles >= 0].mean(axis=0))


def require_same(path: Path, then: Mapping[str, Any], built: Built, learned: Iterable[str]) -> None:
    """Raise UsageError if bodies were moved without their actuators.

    Bodies that have other particles, rotations or shapes cannot be compared, and are accepted.

    Args:
        path: file of the controller. then: `actuator_placement` in the training.
        learned: key paths of the numbers that were learned with the controller.
    """
    now = actuator_placement(built)
    shaped = any(map(shapes_a_body, learned))
    if shaped or (then["particles"], then["lie"]) != (now["particles"], now["lie"]):
        return
    near = NEAR * built.scene.world.dx
    moved = [
        name
        for name, here in now["actuators"].items()
        if np.max(np.abs(np.subtract(then["actuators"][name], here))) > near
    ]
    if moved:
        raise UsageError(
            f"{path}: {listed(moved)} would act on other particles than in the training: a route or a region has a "
            "fixed place in the world and does not move with a body; move it too, or name parts of the body"
        )
