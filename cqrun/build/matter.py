"""A scene's particles as observers, objectives and measurements see them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cqrun.build.model import Built
from cqrun.observers.matter import Matter
from cqrun.plugin.contract import Array
from cqrun.store.recordings import marker_path


def matter_of(built: Built, starts: Mapping[str, Array]) -> Matter:
    """Return the `Matter` of a scene, with the start values of its unknowns by path."""
    scene, particles = built.scene, built.particles
    inputs = built.assembly.inputs(starts)
    return Matter(
        x=particles.x,
        mass=inputs.fields.mass,
        size=np.array(scene.world.size),
        control_step=scene.time.control_step,
        n_controls=scene.time.control_steps,
        bodies={name: particles.of(name) for name in particles.names},
        groups={name: particles.groups(name) for name in particles.names},
        select=particles.inside,
        goals={name: len(goal.position) for name, goal in scene.goals.items()},
        n_actuators=len(built.assembly.actuation.parts),
        recorded=lambda file, units, marker: marker_path(scene.resolve_path(file), units, marker),
        design=built.assembly.design(inputs),
        regions=tuple(scene.regions),
        neutral=built.assembly.actuation.neutral,
        spacing=particles.spacing,
    )
