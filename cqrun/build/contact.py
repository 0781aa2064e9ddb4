"""What bodies of the reference frame touch with, and what they touch: surfaces of bodies, solids of boundaries.

Points lie on the surface of each body at rest, half a cell apart (`geometry/skin.py`). A point has a penalty of
5 E / dx per area, with E of its nearest particle at the scene's values. Under a pressure p its depth is p dx / (5 E).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cqrun.boundaries.condition import BoundaryCondition
from cqrun.boundaries.solid import PLANE, Solid, make_solids, signed_distance
from cqrun.build.alignment import grid_offset, lattice_of
from cqrun.build.assembly import Assembly
from cqrun.build.limits import Limit, contact_limit
from cqrun.build.particles import Particles
from cqrun.build.regions import boundary
from cqrun.build.rigid import rigid_models, rigid_overlaps
from cqrun.build.surfaces import BodySurface, is_obstacle, surface_of, touches
from cqrun.engine.lattice import Lattice
from cqrun.engine.model import ConditionModel
from cqrun.engine.reference.contact import contact_square, in_3d
from cqrun.engine.reference.poses import first_poses
from cqrun.engine.rigid_model import RigidModel
from cqrun.engine.surface import MeetingModel, ObstacleModel, SurfaceModel
from cqrun.errors import Problem, SceneError, UsageError
from cqrun.materials.moduli import moduli_at
from cqrun.plugin.contract import Array
from cqrun.scene.schema import Scene
from cqrun.scene.world_and_time import BodyContact
from cqrun.state import Layout

PENALTY = 5.0
"""Of contact, in E / dx. Twice as much halves the depth at rest, and shortens the substep by a quarter."""

DEEP = 0.1
"""Depth inside an obstacle with which a body must not start [cells]: it would be thrown out."""


class ContactParts(NamedTuple):
    """The parts of a model that contact has, and its conditions, of which obstacles hold no nodes."""

    surface: SurfaceModel | None
    obstacles: tuple[ObstacleModel, ...]
    meeting: MeetingModel | None
    conditions: tuple[ConditionModel, ...]
    rigid: tuple[RigidModel, ...]


def contact_parts(
    scene: Scene, particles: Particles, assembly: Assembly, conditions: tuple[ConditionModel, ...]
) -> ContactParts:
    """Return what a scene's bodies touch with and touch.

    Raises:
        SceneError: a body starts inside an obstacle or a rigid body.
    """
    if not touches(scene):
        return ContactParts(None, (), None, conditions, ())
    surface, obstacles = surface_model(scene, particles, assembly), obstacle_models(scene, conditions)
    rigid = rigid_models(scene, particles, stiffest_contact(scene, particles, assembly)) if scene.rigid else ()
    problems = starts_inside(scene, particles, obstacles, conditions)
    if problems := [*problems, *_rigid_overlaps(scene, particles, assembly, rigid)]:
        raise SceneError(problems)
    held = (replace(c, nodes=np.zeros_like(c.nodes)) if c.spec.is_obstacle else c for c in conditions)
    return ContactParts(surface, obstacles, _meeting(scene), tuple(held), rigid)


def _rigid_overlaps(
    scene: Scene, particles: Particles, assembly: Assembly, rigid: tuple[RigidModel, ...]
) -> list[Problem]:
    if not rigid:
        return []
    surface, (number, waypoints) = surface_of(scene, particles), assembly.rigid.inputs({})
    owner = [particles.names[k] for k in np.searchsorted(surface.begin, np.arange(len(surface.x)), side="right") - 1]
    return rigid_overlaps(scene, rigid, first_poses(rigid, number, waypoints), in_3d(surface.x), owner)


def stiffest_contact(scene: Scene, particles: Particles, assembly: Assembly) -> tuple[float, float]:
    """Return the largest stiffness [Pa/m] and impedance [Pa s/m] of contact per area, of all soft bodies."""
    moduli = [_moduli(particles, assembly, name) for name in particles.names]
    young, impedance = (max(float(each.max()) for each in column) for column in zip(*moduli, strict=True))
    return PENALTY * young / scene.world.dx, impedance


def _meeting(scene: Scene) -> MeetingModel | None:
    """Return how bodies meet each other; an unknown coefficient of friction needs springs, also from zero."""
    if not scene.bodies_meet:
        return None
    contact = scene.world.contact or BodyContact()
    return MeetingModel(contact.coefficient > 0 or "world.contact.coefficient" in scene.unknowns, contact.dashpot)


def surface_model(scene: Scene, particles: Particles, assembly: Assembly) -> SurfaceModel:
    """Return the surfaces with the constants of their contact."""
    surface = surface_of(scene, particles)
    stiffness, impedance = _constants(particles, assembly, surface, scene.world.dx)
    return SurfaceModel(surface.x, surface.particle, stiffness, impedance, surface.area, surface.facets)


def _constants(particles: Particles, assembly: Assembly, surface: BodySurface, dx: float) -> tuple[Array, Array]:
    """Return the penalty's stiffness [N/m] and the impedance [N s/m] of each point (S,), at the scene's values."""
    moduli = [_moduli(particles, assembly, name) for name in particles.names]
    young, impedance = (np.concatenate(each)[surface.particle] for each in zip(*moduli, strict=True))
    return PENALTY * young / dx * surface.area, impedance * surface.area


def _moduli(particles: Particles, assembly: Assembly, body: str) -> tuple[Array, Array]:
    """Return Young's modulus [Pa] and the impedance [Pa s/m] of a body's particles (N_b,), at the scene's values."""
    density, modulus, _ = assembly.stiffness(body, {})
    young = _young(assembly, body, modulus)
    room = particles.room[particles.of(body)]  # a particle of unit mass fills less than its volume of 1
    return young / room, np.sqrt(modulus * density) / room


def _young(assembly: Assembly, body: str, otherwise: Array) -> Array:
    """Return Young's modulus of a body's particles (N_b,) [Pa], or another number if its law does not tell it."""
    elastic, numbers = assembly.scene.bodies[body].material.elastic, assembly.material(body, {})
    law: Any = elastic.value
    rows = {name: numbers[f"bodies.{body}.material.elastic.{elastic.name}.{name}"] for name in law.parameters}
    if "youngs_modulus" in rows:
        return rows["youngs_modulus"]
    moduli = moduli_at(law, np.array(list(rows.values())))
    return otherwise if moduli is None else np.asarray(moduli.young)


# --- obstacles -------------------------------------------------------------------------------------------------------


def obstacle_models(scene: Scene, conditions: Sequence[ConditionModel]) -> tuple[ObstacleModel, ...]:
    """Return the obstacles of a scene.

    Raises:
        UsageError: the distance from the surface of one is not known.
    """
    found = []
    for k, plane in enumerate(conditions):
        spec: Any = plane.spec
        if spec.is_obstacle:
            solids = tuple(_solids(spec, plane, np.array(scene.world.size)))
            found.append(ObstacleModel(k, solids, spec.name != "separate", spec.dashpot))
    return tuple(found)


def _solids(spec: BoundaryCondition, plane: ConditionModel, size: Array) -> list[Solid]:
    if spec.region is not None:
        region: Any = spec.region.value
        return list(region.solids())
    normal = np.array(plane.normal, float)
    point = np.where(normal > 0, spec.thickness, size - spec.thickness) * np.abs(normal)
    return [Solid(PLANE, point[None], normal[None], np.zeros(0))]


# --- checks ----------------------------------------------------------------------------------------------------------


def unknown_surfaces(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield boundaries that bodies cannot touch, because the distance from their surface is not known."""
    for name, chosen in scene.boundaries.items():
        spec: Any = boundary(scene, name)
        if spec.is_obstacle and spec.region is not None:
            try:
                spec.region.value.solids()
            except UsageError as error:
                yield (
                    f"boundaries.{name}.{chosen.name}.region",
                    f"{error}, so bodies of the reference frame cannot touch it: use a half_space, height_field, box, "
                    "ball, capsule, cylinder, cone, polygon, closed mesh, or a union of them, or use "
                    "`world.frame: updated`",
                )


def starts_inside(
    scene: Scene, particles: Particles, obstacles: Sequence[ObstacleModel], conditions: Sequence[ConditionModel]
) -> list[Problem]:
    """Return errors for bodies that start inside an obstacle, from which contact would throw them."""
    problems, surface = [], surface_of(scene, particles)
    x = np.pad(surface.x, ((0, 0), (0, 3 - scene.dim)))
    for obstacle in obstacles:
        table, plane = make_solids(obstacle.solids), conditions[obstacle.condition]
        depth = np.array([-min(signed_distance(table, k, tuple(p))[0] for k in range(len(table.kind))) for p in x])
        deepest = int(depth.argmax())
        if depth[deepest] > DEEP * scene.world.dx:
            body = particles.names[int(np.searchsorted(surface.begin, deepest, side="right")) - 1]
            path = f"boundaries.{plane.name}.{plane.spec.name}"
            at = ", ".join(f"{c:.4g}" for c in surface.x[deepest])
            message = (
                f"the body '{body}' starts {depth[deepest]:.3g} m inside it, at ({at}) m: contact would throw it out; "
                "move one of them"
            )
            problems.append(Problem(scene.where(path), path, message))
    return problems


def contact_limits(
    scene: Scene, particles: Particles, assembly: Assembly, body: str, density: Array, wave: Limit
) -> list[Limit]:
    """Return the bounds on the substep of a body whose surface touches something.

    The frequency of its nodes on all springs of its points is found once, for the scene's values. Other densities have
    at most the square that belongs to the least ratio of masses.

    With another body of the stiffness k', the springs of both surfaces act on the motion of one relative to the other:
    at most 4 k' / (k + k') of the square, 2 if the bodies are alike.

    Args:
        density: mass over volume of each particle (N_b,) [kg/m^D].
        wave: the bound of the body's waves.
    """
    if not touches(scene):
        return []
    base, _, _ = assembly.stiffness(body, {})
    key = f"contact of {body}"
    if key not in particles.found:
        particles.found[key] = _fastest(particles, assembly, body, base, scene.world.dx)
    square, slowest = particles.found[key]
    square *= float((base / density).max())
    limits, names = [], [name for name in scene.boundaries if is_obstacle(scene, name)]
    parts: dict[str, Any] = {
        f"boundaries.{name}.{scene.boundaries[name].name}": scene.boundaries[name].value for name in names
    }
    parts |= {f"rigid.{name}": body for name, body in scene.rigid.items()}
    if parts:
        dashpot, part = max(getattr(each, "dashpot", 0.0) for each in parts.values()), next(iter(parts))
        limits.append(contact_limit(part, wave, square, dashpot * slowest * square))
    if scene.bodies_meet:
        k = {name: _moduli(particles, assembly, name)[0] for name in particles.names}
        other = max(float(k[name].max()) for name in k if name != body)
        square *= 4.0 * other / (other + float(k[body].min()))
        dashpot = (scene.world.contact or BodyContact()).dashpot
        limits.append(contact_limit("bodies", wave, square, dashpot * slowest * square))
    return limits


def _fastest(particles: Particles, assembly: Assembly, body: str, density: Array, dx: float) -> tuple[float, float]:
    """Return the largest squared frequency on the springs of contact [1/s^2], and the largest impedance / stiffness."""
    surface, part, k = surface_of(assembly.scene, particles), particles.of(body), particles.names.index(body)
    own = slice(int(surface.begin[k]), int(surface.begin[k + 1]))
    stiffness, impedance = (a[own] for a in _constants(particles, assembly, surface, dx))
    offset, lattice = grid_offset(assembly.scene, particles), lattice_of(assembly.scene, particles)
    assert offset is not None  # contact belongs to the reference frame
    assert lattice is not None
    square = contact_square(
        Layout(assembly.scene.dim, (part.stop - part.start,)), particles.x[part], density * particles.volume[part],
        surface.particle[own] - part.start, surface.x[own], stiffness, dx, offset[[k]],
        Lattice(lattice.x[part], lattice.spacing[[k]]),
    )  # fmt: skip
    return square, float((impedance / stiffness).max())
