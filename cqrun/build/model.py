"""Build the engine's model of a scene: particles, stress terms, boundaries, actuators and the substep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from cqrun.build.alignment import alignment_warnings, grid_offset, lattice_of
from cqrun.build.assembly import Assembly
from cqrun.build.check_design import design_problems, design_warnings
from cqrun.build.check_frame import frame_problems
from cqrun.build.check_grid import grid_warnings
from cqrun.build.check_material import material_warnings, relaxation_problems
from cqrun.build.check_routes import route_warnings, spool_problems
from cqrun.build.check_units import require_possible_plan, unit_questions
from cqrun.build.conditions import all_conditions
from cqrun.build.contact import contact_parts
from cqrun.build.history import fields_of
from cqrun.build.limits import (
    Limit,
    rounded_away,
)
from cqrun.build.particles import Particles, sample, stress_key
from cqrun.build.raster import Raster, rasterised
from cqrun.build.reactions import centers, needed_boundaries
from cqrun.build.rigid import rigid_problems
from cqrun.build.substep import with_substeps
from cqrun.build.volumes import averages, locking_bodies
from cqrun.engine.model import GroupModel, Model
from cqrun.engine.reference.patches import count_nodes
from cqrun.errors import Problem, SceneError
from cqrun.materials.term import is_stress
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import bounds_of


@dataclass(frozen=True)
class Built:
    """A scene ready to run.

    Attributes:
        scene: the resolved scene, in which `time.substeps` is a number.
        particles: its particles.
        model: the engine's model.
        assembly: maps values by key path to the engine's inputs, and gradients back.
        limits: bounds on the substep at the stiffest corner of the unknowns' bounds.
        warnings: what a user should know before the run.
        rasters: the shape of each body by name, to measure its thickness.
    """

    scene: Scene
    particles: Particles
    model: Model
    assembly: Assembly
    limits: tuple[Limit, ...]
    warnings: tuple[Problem, ...]
    rasters: dict[str, Raster]


def build(scene: Scene) -> Built:
    """Build a scene.

    Raises:
        SceneError: bodies or regions are not valid, the substep is too large, or there is too little memory.
    """
    particles = sample(scene)
    if problems := [*design_problems(scene, particles), *spool_problems(scene)]:
        raise SceneError(problems)
    if problems := [Problem(scene.where(path), path, message) for path, message in rigid_problems(scene)]:
        raise SceneError(problems)
    assembly = Assembly(scene, particles)
    scene, limits, bounds, doubts = with_substeps(scene, particles, assembly)
    assembly = Assembly(scene, particles)
    warnings = [
        *particles.warnings,
        *unit_questions(scene),
        *_unused_episodes(scene),
        *_plugin_warnings(scene),
        *design_warnings(scene, particles),
    ]
    warnings += [*_truths_out_of_reach(scene), *_loose_constraints(scene)]
    warnings += doubts
    require_possible_plan(scene, bounds)
    warnings += [*_too_slow(scene, assembly), *material_warnings(scene)]
    conditions = all_conditions(scene)
    if problems := [*frame_problems(scene, particles, conditions), *relaxation_problems(scene)]:
        raise SceneError(problems)
    surface, obstacles, meeting, conditions, rigid = contact_parts(scene, particles, assembly, conditions)
    rasters = {name: rasterised(body, scene.world.dx) for name, body in scene.bodies.items()}
    warnings += locking_bodies(scene, rasters)
    warnings += [*grid_warnings(scene, particles, conditions, rasters), *alignment_warnings(scene, particles)]
    warnings += route_warnings(scene, particles, assembly.actuation.every)
    offset = grid_offset(scene, particles)
    model = Model(
        size=np.array(scene.world.size),
        dx=scene.world.dx,
        dt=scene.time.control_step / int(scene.time.substeps),
        substeps=int(scene.time.substeps),
        n_controls=scene.time.control_steps,
        body_names=particles.names,
        layout=particles.layout,
        groups=_groups(scene, particles, assembly),
        conditions=conditions,
        actuators=tuple(part.model for part in assembly.actuation.parts),
        forces=tuple(part.model for part in assembly.actuation.passive),
        real=np.dtype(scene.precision).type,
        memory_budget=scene.memory,
        frame=scene.world.frame,
        averaged=averages(scene),
        settled=scene.start == "equilibrium",
        surface=surface,
        obstacles=obstacles,
        meeting=meeting,
        rigid=rigid,
        offset=offset,
        lattice=lattice_of(scene, particles),
        n_nodes=0 if offset is None else count_nodes(particles.layout, particles.x, scene.world.dx, offset),
        reactions=needed_boundaries(scene),
        centers=centers(scene, particles, conditions) if scene.world.frame == "reference" else {},
        regions={(body, name): p for body in particles.names for name, p in particles.groups(body).items()},
    )
    return Built(scene, particles, model, assembly, tuple(limits), tuple(warnings), rasters)


def _unused_episodes(scene: Scene) -> list[Problem]:
    """Return a warning if all episodes would be the same."""
    episodes = scene.episodes
    if (episodes.count == 1 and not episodes.unseen) or any(goal.drawn for goal in scene.goals.values()):
        return []
    message = "has no effect: no goal has a `spread` to draw from, so all episodes are the same"
    return [Problem(scene.where("episodes"), "episodes", message)]


def _truths_out_of_reach(scene: Scene) -> list[Problem]:
    """Return warnings for true values outside the bounds of their unknowns, which no fit can find."""
    warnings = []
    for path, value in scene.synthetic.truth.items() if scene.synthetic is not None else ():
        bounds = bounds_of(scene, path)
        if bounds is not None and not bounds[0] <= value <= bounds[1]:
            key = f"data.synthetic.truth.{path}"
            message = f"{value:g} lies outside the unknown's bounds {bounds[0]:g} to {bounds[1]:g}: no fit can find it"
            warnings.append(Problem(scene.where(key), key, message))
    return warnings


def _loose_constraints(scene: Scene) -> list[Problem]:
    """Return warnings for constraints with a large tolerance; bounds of a small robot are small in SI units."""
    tolerance = 0.0 if scene.optimizer is None else getattr(scene.optimizer.value, "constraint_tolerance", 0.0)
    warnings = []
    for name, constraint in scene.constraints.items():
        if (end := constraint.loose_end(tolerance)) is not None:
            value, path = getattr(constraint, end), f"constraints.{name}.{end}"
            message = (
                f"{value:g} counts as met when it is missed by {tolerance * constraint.scale:.3g}: the "
                f"constraint_tolerance of {tolerance:g} is in units of the constraint's `scale`, {constraint.scale:g}; "
                f"with `scale: {abs(value):g}` it would be {tolerance * abs(value):.3g}"
            )
            warnings.append(Problem(scene.where(path), path, message))
    return warnings


def _plugin_warnings(scene: Scene) -> list[Problem]:
    """Return the warnings of the controller, and of the terms of the objective and the constraints."""
    sources: list[tuple[str, Iterator[tuple[str, str]]]] = []
    if scene.controller is not None:
        controller: Any = scene.controller.value
        sources.append((f"controller.{scene.controller.name}", controller.likely_mistakes(scene.time.control_step)))
    actuators: dict[str, Any] = {name: chosen.value for name, chosen in scene.actuators.items()}
    neutral = {name: actuator.neutral for name, actuator in actuators.items()}
    terms: dict[str, Any] = {f"objective.{name}.{c.name}": c.value for name, c in scene.objective.items()}
    terms |= {f"constraints.{name}.of.{c.of.name}": c.of.value for name, c in scene.constraints.items()}
    sources += [(path, term.likely_mistakes(neutral)) for path, term in terms.items()]
    messages = ((f"{path}.{field}", message) for path, warned in sources for field, message in warned)
    return [Problem(scene.where(path), path, message) for path, message in messages]


def _groups(scene: Scene, particles: Particles, assembly: Assembly) -> tuple[GroupModel, ...]:
    parts = [part for part in assembly.actuation.parts if is_stress(part.model.kernel)]
    groups = []
    for _, members in groupby(enumerate(particles.names), key=lambda item: stress_key(scene, item[1])):
        indices, names = zip(*members, strict=True)
        material = scene.bodies[names[0]].material
        specs: list[Any] = [material.elastic.value, *material.terms.values()]
        makers = tuple(spec.kernel_term for spec in specs)
        active = dict.fromkeys(part.model.kernel for part in parts if part.spec.body in names)
        history = tuple(tuple(field.name for field in fields_of(spec, scene.dim)) for spec in specs)
        shear, wave = tuple(spec.shear_modulus for spec in specs), tuple(spec.wave_modulus for spec in specs)
        fading = tuple(name for spec, own in zip(specs, history, strict=True) for name in own if spec.relaxes)
        groups.append(GroupModel(tuple(indices), makers, tuple(active), history, shear, wave, fading))
    return tuple(groups)


def _too_slow(scene: Scene, assembly: Assembly) -> list[Problem]:
    """Return warnings for bodies that start so slowly that float32 would leave them where they are."""
    if scene.precision != "float32":
        return []
    least = rounded_away(np.array(scene.world.size), scene.time.control_step / int(scene.time.substeps))
    warnings = []
    for name in scene.bodies:
        fastest = float(np.linalg.norm(assembly.velocities(name, {}), axis=1).max())
        if 0 < fastest < least:
            path = f"bodies.{name}.velocity"
            message = (
                f"starts at {fastest:.3g} m/s, but float32 loses motion slower than about {least:.3g} m/s, so the body "
                "stays where it is: use float64, or fewer substeps"
            )
            warnings.append(Problem(scene.where(path), path, message))
    return warnings
