"""The rigid bodies of a scene: their parts of the model, what they allow as a substep, and where they must not be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import eigvalsh

from cqrun.boundaries.solid import Solid, make_solids, signed_distance
from cqrun.build.inertia import MassProperties, mass_properties, principal
from cqrun.build.limits import Limit, contact_limit
from cqrun.build.particles import Particles
from cqrun.build.surfaces import PER_CELL
from cqrun.engine.rigid_model import RigidModel
from cqrun.errors import Problem, UsageError
from cqrun.explain import listed
from cqrun.geometry.shape import Shape
from cqrun.geometry.skin import Skin, make_skin
from cqrun.plugin.contract import Array
from cqrun.scene.rigid import RigidBody
from cqrun.scene.schema import Scene

DEEP = 0.1
"""Depth inside a rigid body with which a body must not start [cells]: it would be thrown out."""


@dataclass(frozen=True)
class RigidPart:
    """What is known of a rigid body from its shape.

    Attributes:
        properties: of the shape; None if it is infinite.
        center: of mass at rest, before the offset (3,) [m].
        moments, axes: of a free body; those of a mass of 1, unless the scene gives its moments.
        skin: of a free body.
        spring: stiffness (6, 6) of a spring of 1 N/m^3 at every point of the skin.
    """

    properties: MassProperties | None
    center: Array
    moments: Array
    axes: Array
    skin: Skin | None
    spring: Array


def parts_of(scene: Scene, particles: Particles) -> dict[str, RigidPart]:
    """Return what is known of each rigid body; it is found once."""
    known: dict[str, RigidPart] | None = particles.found.get("rigid")
    if known is None:
        known = particles.found["rigid"] = {name: _part(scene, body) for name, body in scene.rigid.items()}
    return known


def solids_of(body: RigidBody) -> list[Solid]:
    """Return the solids of a rigid body, before its offset.

    Raises:
        UsageError: the distance from its surface is not known.
    """
    return list(body.shape.value.solids())


def is_infinite(body: RigidBody) -> bool:
    """Return whether the shape of a body has no bounds."""
    return not np.isfinite(np.array(body.shape.value.bounds())).all()


def _part(scene: Scene, body: RigidBody) -> RigidPart:
    found = None if is_infinite(body) else mass_properties(body.shape.value, solids_of(body))
    center = np.pad(0.5 * np.array(scene.world.size), (0, 3 - scene.dim)) if found is None else found.center
    if body.center is not None:
        center = np.pad(np.array(body.center, float), (0, 3 - scene.dim))
    if not body.free or found is None:
        return RigidPart(found, center, np.ones(3), np.eye(3), None, np.zeros((6, 6)))
    shape: Shape = body.shape.value
    lower, upper = shape.bounds()
    measure: Any = shape.distance if shape.distance(lower[None]) is not None else None
    skin = make_skin(shape.inside, lower, upper, scene.world.dx / PER_CELL, measure)
    arms = np.pad(skin.x, ((0, 0), (0, 3 - scene.dim))) - center
    J = np.concatenate([np.broadcast_to(np.eye(3), (len(arms), 3, 3)), np.cross(np.eye(3), arms[:, None])], axis=2)
    spring = np.einsum("s,sij,sik->jk", skin.area, J, J)
    return RigidPart(found, center, *_inertia(scene.dim, body, found, center), skin, spring)


def _inertia(dim: int, body: RigidBody, found: MassProperties, center: Array) -> tuple[Array, Array]:
    """Return the moments (3,) of a free body and their axes; see `RigidPart`."""
    if body.inertia is not None:
        return principal(np.diag(np.resize(np.array(body.inertia, float), 3)))
    arm = found.center - center
    further = arm @ arm * np.eye(3) - (0.0 if dim == 2 else np.outer(arm, arm))
    return principal(found.inertia / found.volume + further)


def rigid_models(scene: Scene, particles: Particles, stiffest: tuple[float, float]) -> tuple[RigidModel, ...]:
    """Return the rigid bodies of a scene; `stiffest` are stiffness [Pa/m] and impedance [Pa s/m] of contact."""
    parts = parts_of(scene, particles)
    return tuple(_model(scene, name, body, parts[name], stiffest) for name, body in scene.rigid.items())


def _model(scene: Scene, name: str, body: RigidBody, part: RigidPart, stiffest: tuple[float, float]) -> RigidModel:
    rubs, times = is_rubbing(scene, name, body), np.array([point.time for point in body.waypoints])
    plain = RigidModel(name, tuple(solids_of(body)), part.center, _radius(scene, body, part), rubs, body.dashpot,
                       times=times)  # fmt: skip
    if part.skin is None:
        return plain
    x, area = np.pad(part.skin.x, ((0, 0), (0, 3 - scene.dim))), part.skin.area
    return replace(plain, free=True, axes=part.axes, skin=x, stiffness=stiffest[0] * area, impedance=stiffest[1] * area)


def is_rubbing(scene: Scene, name: str, body: RigidBody) -> bool:
    """Return whether a body has friction, or may have it: an unknown coefficient needs springs, also from zero."""
    return body.friction > 0 or f"rigid.{name}.friction" in scene.unknowns


def _radius(scene: Scene, body: RigidBody, part: RigidPart) -> float:
    """Return the radius of a ball about the centre that contains the body, or the world if the body is infinite."""
    if part.properties is None:
        return float(np.linalg.norm(scene.world.size) + np.linalg.norm(part.center))
    reach = [np.abs(np.pad(end, (0, 3 - scene.dim)) - part.center) for end in body.shape.value.bounds()]
    return float(np.linalg.norm(np.maximum(*reach)))


def rigid_limits(
    scene: Scene, particles: Particles, wave: Limit, stiffest: tuple[float, float], masses: Mapping[str, float]
) -> Iterator[Limit]:
    """Yield the bounds on the substep of free bodies; they hold for bodies with all of their skin in contact.

    Args:
        wave: the bound of the soft bodies.
        stiffest: as in `rigid_models`.
        masses: of the bodies by name [kg].
    """
    dashpots = [getattr(chosen.value, "dashpot", 0.0) for chosen in scene.boundaries.values()]
    for name, part in parts_of(scene, particles).items():
        if part.skin is not None:
            body, inverse = scene.rigid[name], np.zeros((6, 6))
            moments = part.moments * (1.0 if body.inertia is not None else masses[name])
            inverse[:3, :3], inverse[3:, 3:] = masses[name] * np.eye(3), part.axes.T @ np.diag(moments) @ part.axes
            square = float(eigvalsh(part.spring, inverse).max())
            rate = max([body.dashpot, *dashpots]) * stiffest[1] * square
            yield contact_limit(f"rigid.{name}", wave, stiffest[0] * square, rate)


# --- checks ----------------------------------------------------------------------------------------------------------


def rigid_problems(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield what is wrong with rigid bodies."""
    if scene.rigid and scene.world.frame != "reference":
        yield "rigid", "rigid bodies are touched in the reference frame alone: set `world.frame: reference`"
        return
    for name, body in scene.rigid.items():
        path = f"rigid.{name}"
        try:
            solids_of(body)
        except UsageError as error:
            yield (
                f"{path}.shape",
                f"{error}, so soft bodies cannot touch it: use a half_space, height_field, box, ball, capsule, "
                "cylinder, cone, polygon, closed mesh, or a union of them",
            )
            continue
        if is_infinite(body) and body.free:
            yield f"{path}.shape", "is infinite, so the body has no mass and cannot move freely: bound it"
        if is_infinite(body) and body.center is None and any(any(point.rotation) for point in body.waypoints):
            yield path, "turns about its centre, but its shape is infinite and has none: give a `center`"
    yield from _glue_problems(scene)
    if scene.rigid and scene.start == "equilibrium":
        yield "start", f"an equilibrium does not feel rigid bodies yet ({listed(scene.rigid)}): remove `start`"
    free = [name for name, body in scene.rigid.items() if body.free]
    if free and scene.precision != "float64":
        yield "precision", f"is {scene.precision}, too coarse for the small turns of '{free[0]}': use float64"


def _glue_problems(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield boundaries that cannot be glued to their rigid body."""
    for name, chosen in scene.boundaries.items():
        to = getattr(chosen.value, "to", None)
        body = scene.rigid.get(to or "")
        if body is None:
            continue
        path = f"boundaries.{name}.{chosen.name}.to"
        if body.free:
            yield path, f"the rigid body '{to}' moves freely, and nothing can be glued to it yet: give it a `path`"
        if any(body.offset) or any(key.startswith(f"rigid.{to}.offset") for key in scene.unknowns):
            yield path, f"the rigid body '{to}' has an `offset`, which the patch would not follow: move its shape"
        first = body.waypoints[0] if body.waypoints else None
        if first is not None and first.time == 0 and any([*first.displacement, *first.rotation]):
            yield path, f"the path of '{to}' begins elsewhere than its shape, away from the patch: move its shape there"


def depths(model: RigidModel, pose: Array, x: Array) -> Array:
    """Return how deep points x (n, 3) [m] are in a body with a pose (13,): (n,) [m], negative outside."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_quat(pose[[4, 5, 6, 3]]).inv()
    y, table = model.center + turned.apply(x - pose[:3]), make_solids(model.solids)
    return np.array([-min(signed_distance(table, k, tuple(p))[0] for k in range(len(table.kind))) for p in y])


def rigid_overlaps(
    scene: Scene, models: Sequence[RigidModel], poses: Sequence[Array], surface: Array, owner: Sequence[str]
) -> list[Problem]:
    """Return errors for bodies that start inside a rigid body.

    Args:
        poses: of the models at the start (13,).
        surface: points of soft surfaces (S, 3) [m].
        owner: the soft body of each.
    """
    problems = []
    for model, pose in zip(models, poses, strict=True):
        path, depth = f"rigid.{model.name}", depths(model, pose, surface)
        deepest = int(depth.argmax())
        if depth[deepest] > DEEP * scene.world.dx:
            at = ", ".join(f"{c:.4g}" for c in surface[deepest][: scene.dim])
            message = (
                f"starts {depth[deepest]:.3g} m inside the soft body '{owner[deepest]}', at ({at}) m: contact would "
                "throw them apart; move one of them"
            )
            problems.append(Problem(scene.where(path), path, message))
        for other, other_pose in zip(models, poses, strict=True):
            if model.free and other is not model:
                skin = pose[:3] + model.skin - model.center
                if depths(other, other_pose, skin).max() > 0.0:
                    message = f"starts inside the rigid body '{other.name}', and rigid bodies do not feel each other"
                    problems.append(Problem(scene.where(path), path, f"{message}: move one of them"))
    return problems
