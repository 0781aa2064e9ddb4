"""A scene's particles as observers, objectives and measurements see them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cqrun.actuators.chamber import is_chamber
from cqrun.actuators.tendon import Line
from cqrun.build.model import Built
from cqrun.engine.reference.corners import hat_slopes, hats
from cqrun.engine.reference.rest import rest_geometry
from cqrun.observers.matter import ActuatorPart, Corners, Material, Matter, Route, Wall
from cqrun.observers.rows import slices
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
        n_parts=len(built.assembly.actuation.every),
        strength=inputs.strength,
        rest_length=inputs.rest,
        parts=_parts(built),
        routes=_routes(built),
        walls=_walls(built),
        materials=_materials(built),
        terms=inputs.terms,
        corners=_corners(built),
        room=particles.room,
        measures={name: chosen.value for name, chosen in scene.measure.items()},  # type: ignore[misc]
    )


def _materials(built: Built) -> dict[str, Material]:
    """Return where the parameters of each body's material are."""
    names = built.particles.names
    return {
        names[k]: Material(g, built.particles.of(names[group.bodies[0]]).start, group.kernel_terms)
        for g, group in enumerate(built.model.groups)
        for k in group.bodies
    }


def _corners(built: Built) -> Corners | None:
    """Return the corners of cells, if volumes are averaged over them."""
    if not built.model.averaged:
        return None
    model = built.model
    return Corners(lambda x: hats(rest_geometry(model, x)), lambda x: hat_slopes(rest_geometry(model, x)))


def _parts(built: Built) -> tuple[ActuatorPart, ...]:
    """Return the parts of all actuators."""
    parts = built.assembly.actuation.parts
    places = slices([len(part.model.particles) for part in parts])
    return tuple(
        ActuatorPart(part.name, part.actuator, k, part.spec, part.model.particles, part.model.constants, at)
        for k, (part, at) in enumerate(zip(parts, places, strict=True))
    )


def _routes(built: Built) -> dict[str, Route]:
    """Return the cables and springs of a scene, by name."""
    routes, activated = {}, len(built.assembly.actuation.parts)
    for k, part in enumerate(built.assembly.actuation.every):
        if not hasattr(part.spec, "pull"):
            continue
        model, count = part.model, len(part.model.particles)
        lines = part.spec.lines(model.constants, count) if hasattr(part.spec, "lines") else [Line(count, 0.0, 1.0)]
        begin, x = 0, model.at_rest(built.particles.x)
        for number, line in enumerate(lines):
            own, begin = slice(begin, begin + line.points), begin + line.points
            offsets = model.offsets[own] if part.exact and model.offsets is not None else None
            name = f"{part.name}.{number}" if number else part.name
            routes[name] = Route(
                model.particles[own], k, part.spec, k < activated, offsets, x[own], line.begin, line.turn
            )  # fmt: skip
    return routes


def _walls(built: Built) -> dict[str, Wall]:
    """Return the walls of a scene's chambers, by name."""
    return {
        part.name: Wall(part.model.particles, part.model.offsets, part.spec.facets(part.model.constants), k, part.spec)
        for k, part in enumerate(built.assembly.actuation.parts)
        if is_chamber(part.spec) and part.model.offsets is not None
    }
