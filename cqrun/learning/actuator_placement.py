"""Whether actuators act on the particles that a controller was trained with, where bodies were only moved.

Routes and regions lie at places in the world; a body that is moved for a replay leaves them behind.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.build.model import Built
from cqrun.errors import UsageError
from cqrun.explain import listed
from cqrun.scene.paths import shapes_a_body

NEAR = 1e-6
"""Cells within which two places are the same."""


def acted_on(built: Built) -> dict[str, Any]:
    """Return where each actuator's particles are beside their body's middle, and how bodies lie but for an offset."""
    particles, x = built.particles, built.particles.x
    middles = {
        part.name: (x[part.model.particles].mean(axis=0) - x[particles.of(part.spec.body)].mean(axis=0)).tolist()
        for part in built.assembly.actuation.parts
    }
    places = {name: body.place for name, body in built.scene.bodies.items()}
    lie = {name: place and place.model_dump(mode="json", exclude={"offset"}) for name, place in places.items()}
    return {"particles": len(x), "lie": lie, "actuators": middles}


def require_same(path: Path, then: Mapping[str, Any], built: Built, learned: Iterable[str]) -> None:
    """Refuse, with a UsageError, a scene whose bodies were moved without what acts on them.

    Bodies that were sampled, turned or shaped otherwise cannot be compared, and are taken.

    Args:
        path: of the controller. then: what `acted_on` said in the training.
        learned: key paths of numbers that were learned with it.
    """
    now = acted_on(built)
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
            f"{path}: {listed(moved)} would act on other particles than in the training: a route or a region lies at a "
            "place in the world, and does not move with a body; move it too, or name parts of the body"
        )
