"""Check what the reference frame cannot do: such a scene is refused, with the other frame as the way out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from cqrun.build.alignment import HOLDS
from cqrun.build.check_clamps import nearest_to
from cqrun.build.check_holds import reached_nodes, unheld_problems
from cqrun.build.contact import unknown_surfaces
from cqrun.build.history import remembering
from cqrun.build.particles import Particles
from cqrun.build.reactions import boundaries_by_user
from cqrun.build.volumes import volume_problems
from cqrun.engine.model import ConditionModel
from cqrun.engine.reference.held import held_at
from cqrun.errors import Problem
from cqrun.explain import listed
from cqrun.scene.schema import Scene

PER_AXIS = 2
"""Particles in a cell along each axis, at least: with one, nodes can move in ways that no particle feels."""

SLIVERS = 0.05
"""A fitted lattice has particles with slivers of the shape added, so that their mean is larger than a cell of it."""

ROUNDING = 1e-6

TOO_COARSE = "is {}, too coarse for bodies at rest: use float64"

WAY_OUT = "use `world.frame: updated`"


def frame_problems(scene: Scene, particles: Particles, conditions: Sequence[ConditionModel]) -> list[Problem]:
    """Return what a scene asks of the reference frame that this frame cannot do."""
    if scene.world.frame != "reference":
        found = list(_elsewhere(scene))
        return [Problem(scene.where(path), path, message) for path, message in found]
    found = [
        *unknown_surfaces(scene),
        *_holds(scene, particles, conditions),
        *_thin(scene, particles),
        *volume_problems(scene),
        *_at_rest(scene),
    ]
    problems = [Problem(scene.where(path), path, message) for path, message in found]
    if scene.start == "equilibrium" and not problems:
        problems = unheld_problems(scene, particles, conditions)
    return problems


def _elsewhere(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield what only the reference frame can do."""
    if scene.world.contact is not None:
        yield "world.contact", "acts in the reference frame alone: set `world.frame: reference`"
    if scene.world.volume == "averaged":
        yield "world.volume", "volumes are averaged in the reference frame alone: set `world.frame: reference`"
    for name, chosen in scene.boundaries.items():
        if getattr(chosen.value, "moves", False):
            yield f"boundaries.{name}.{chosen.name}", "moves in the reference frame alone: set `world.frame: reference`"
    for path, names in boundaries_by_user(scene):
        which = listed([f"'{name}'" for name in names])
        yield path, f"the force of {which} is known in the reference frame alone: set `world.frame: reference`"
    for name, chosen in scene.actuators.items():
        if getattr(chosen.value, "frame", None) == "reference":
            path = f"actuators.{name}.{chosen.name}"
            yield path, "acts in the reference frame alone: set `world.frame: reference`"
    if scene.start == "equilibrium":
        yield "start", "is found in the reference frame alone: set `world.frame: reference`"


def _at_rest(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield bodies that cannot both start at rest and move."""
    if scene.start == "equilibrium":
        for path, kind in touched(scene):
            yield "start", f"an equilibrium does not feel `{kind}` boundaries yet ({path}): remove them, or `start`"
        for path, name in remembering(scene):
            yield path, f"the stress of `{name}` has a history, and so no equilibrium: remove it, or `start`"
        if scene.bodies_meet:
            yield "start", "bodies do not feel each other in an equilibrium yet: use one body, or remove `start`"
        if scene.precision != "float64":
            yield "precision", TOO_COARSE.format(scene.precision)
        for name, body in scene.bodies.items():
            for key in ("velocity", "spin"):
                if any(getattr(body, key)):
                    yield (
                        f"bodies.{name}.{key}",
                        "has no effect with `start: equilibrium`, where all bodies start at rest",
                    )


def touched(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield the key path and the kind of every boundary that bodies touch, in place of being held by it."""
    for name, chosen in scene.boundaries.items():
        if chosen.name not in HOLDS:
            yield f"boundaries.{name}.{chosen.name}", chosen.name


def _holds(scene: Scene, particles: Particles, conditions: Sequence[ConditionModel]) -> Iterator[tuple[str, str]]:
    """Yield clamps that hold no particle: a body that reaches them later would not feel them."""
    reached = reached_nodes(scene, particles).X
    for name, chosen in scene.boundaries.items():
        planes = [plane for plane in conditions if plane.name == name]
        if chosen.name in HOLDS and not held_at(planes, reached, np.array(scene.world.size)).bits.any():
            path, nodes = f"boundaries.{name}.{chosen.name}", np.any([plane.nodes for plane in planes], axis=0)
            nearest = ""
            if nodes.any():
                nearest = f" ({nearest_to(scene, particles, nodes, particles.names).told(scene.world.dx)})"
            yield (
                path,
                (
                    f"holds no particle at rest{nearest}, and in the reference frame it holds only what it holds at "
                    f"rest: move it onto the body, make it thicker than a cell of {scene.world.dx:g} m, make it "
                    f"`friction` or `separate`, which bodies touch, or {WAY_OUT}"
                ),
            )


def _thin(scene: Scene, particles: Particles) -> Iterator[tuple[str, str]]:
    """Yield bodies with too few particles."""
    for name, spacing in particles.spacing.items():
        per_axis = scene.world.dx / spacing
        slack = SLIVERS if getattr(scene.bodies[name].sampling.value, "fitted", False) else ROUNDING
        if per_axis < PER_AXIS * (1 - slack):
            need = PER_AXIS**scene.dim
            yield (
                f"bodies.{name}.particles_per_cell",
                (
                    f"has {per_axis**scene.dim:.3g} particles in a cell, too few for the reference frame: nodes would "
                    f"move without resistance; use {need} or more, or {WAY_OUT}"
                ),
            )
