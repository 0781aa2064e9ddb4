"""Build the engine's model of a scene: particles, stress terms, boundaries, actuators and the substep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from cqrun.build.actuation import Actuation
from cqrun.build.alignment import alignment_warnings, grid_offset, lattice_of
from cqrun.build.assembly import Assembly
from cqrun.build.check_design import design_problems, design_warnings
from cqrun.build.check_frame import frame_problems
from cqrun.build.check_grid import grid_warnings
from cqrun.build.check_material import material_warnings, relaxation_problems
from cqrun.build.check_routes import route_warnings, spool_problems
from cqrun.build.check_units import require_possible_plan, unit_questions
from cqrun.build.conditions import all_conditions
from cqrun.build.contact import contact_limits, contact_parts, stiffest_contact
from cqrun.build.history import fields_of
from cqrun.build.limits import (
    MOST_SUBSTEPS,
    REFUSE,
    WARN,
    Limit,
    auto_substeps,
    motion_limit,
    push_limit,
    rounded_away,
    wave_limit,
)
from cqrun.build.particles import Particles, sample, stress_key
from cqrun.build.raster import Raster, rasterised
from cqrun.build.reactions import centers, needed_boundaries
from cqrun.build.rigid import rigid_limits, rigid_problems
from cqrun.build.volumes import averages, locking_bodies
from cqrun.engine.model import GroupModel, Model
from cqrun.engine.reference.patches import count_nodes
from cqrun.errors import Problem, SceneError
from cqrun.materials.term import is_stress
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import body_of
from cqrun.scene.paths import with_values
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import bounds_of, has_own_values, scene_of_recording, start, tied, truths

WASTEFUL = 1e-3
"""A substep smaller than this part of the largest stable one is probably a mistake."""


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
    limits = _possible(scene, _stiffest(scene, particles, assembly))
    warnings = [
        *particles.warnings,
        *unit_questions(scene),
        *_unused_episodes(scene),
        *_plugin_warnings(scene),
        *locking_bodies(scene),
        *design_warnings(scene, particles),
    ]
    warnings += [*_truths_out_of_reach(scene), *_loose_constraints(scene)]
    if scene.time.substeps == "auto":
        bounds = [*limits, *_possible(scene, _limits_of_data(scene, particles, assembly))]
        scene = with_values(scene, {"time.substeps": auto_substeps(scene.time.control_step, bounds)})
        assembly = Assembly(scene, particles)
    else:
        reached = [path for path in scene.unknowns if assembly.reaches(path)]
        starts = {p: np.array(v) for path in reached for p, v in tied(scene, path, start(scene, path)).items()}
        bounds = _possible(scene, _limits(scene, particles, assembly, starts))
        if truth := _truth(scene):
            bounds += _possible(scene, _limits(scene, particles, assembly, truth))
        warnings += _check_substeps(scene, bounds) or _check_corner(scene, limits)
    require_possible_plan(scene, bounds)
    warnings += [*_too_slow(scene, assembly), *material_warnings(scene)]
    conditions = all_conditions(scene)
    if problems := [*frame_problems(scene, particles, conditions), *relaxation_problems(scene)]:
        raise SceneError(problems)
    surface, obstacles, meeting, conditions, rigid = contact_parts(scene, particles, assembly, conditions)
    rasters = {name: rasterised(body, scene.world.dx) for name, body in scene.bodies.items()}
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


# --- the substep ------------------------------------------------------------------------------------------


def stable(built: Built, values: dict[str, Array]) -> tuple[Limit, int]:
    """Return the smallest bound on the substep for values by path, and the number of substeps that `auto` would give.

    Raises:
        SceneError: the bound is too small for any run.
    """
    scene = built.scene
    limits = _possible(scene, _limits(scene, built.particles, built.assembly, values))
    return min(limits, key=lambda limit: limit.dt), auto_substeps(scene.time.control_step, limits)


def _limits(scene: Scene, particles: Particles, assembly: Assembly, values: dict[str, Array]) -> list[Limit]:
    """Return the bound of every part on the substep, for some values of the unknowns."""
    limits: list[Limit] = []
    actuation = assembly.actuation
    active = actuation.largest_stress(values)
    for name in particles.names:
        part = particles.of(name)
        density, modulus, viscosity = assembly.stiffness(name, values)
        limit = wave_limit(f"bodies.{name}.material", scene.world.dx, density, modulus + active[part], viscosity)
        limits += [limit, *contact_limits(scene, particles, assembly, name, density, limit)]
        moving = motion_limit(f"bodies.{name}.velocity", scene.world.dx, assembly.velocities(name, values))
        limits += [moving] if moving else []
        lightest = float(density.min()) * scene.world.dx**scene.dim
        if scene.bodies[name].unit_mass:  # its particles fill less space than their volume of 1
            lightest /= particles.spacing[name] ** scene.dim
        limits += _push_limits(scene, actuation, values, name)
        limits += _spring_limits(scene, particles, actuation, values, name, lightest)
    if scene.rigid:
        softest = min(limits, key=lambda limit: limit.dt)
        stiffest = stiffest_contact(scene, particles, assembly)
        limits += rigid_limits(scene, particles, softest, stiffest, assembly.rigid.masses(values))
    return limits


def _push_limits(scene: Scene, actuation: Actuation, values: dict[str, Array], body: str) -> list[Limit]:
    """Return the bounds of the actuators that accelerate particles of a body directly."""
    each = zip(actuation.parts, actuation.largest_activation(values), actuation.strengths(values), strict=False)
    limits = [
        push_limit(part.path, scene.world.dx, part.spec.greatest_acceleration(activation * strength))
        for part, activation, strength in each
        if part.spec.body == body
    ]
    return [limit for limit in limits if limit is not None]


def _spring_limits(
    scene: Scene, particles: Particles, actuation: Actuation, values: dict[str, Array], body: str, mass: float
) -> list[Limit]:
    """Return the bound of the actuators that pull like springs at nodes of a mass [kg].

    A mass m on springs with the total stiffness k oscillates with omega^2 = k / m and is stable up to dt = 2 / omega.
    The stiffnesses of actuators in the same cell are added.
    """
    parts = [
        (part.path, part.model.at_rest(particles.x), k)
        for part, strength in zip(actuation.every, actuation.strengths(values), strict=True)
        if body_of(part.spec) == body
        and (k := part.spec.stiffness_at_nodes(strength, part.model.at_rest(particles.x))) > 0.0
    ]
    if not parts:
        return []
    cells = [np.unique(np.floor(points / scene.world.dx), axis=0) for _, points, _ in parts]
    every, place = np.unique(np.concatenate(cells), axis=0, return_inverse=True)
    total = np.bincount(place.ravel(), np.repeat([k for *_, k in parts], [len(c) for c in cells]), len(every))
    stiffest = max(parts, key=lambda part: part[2])
    return [Limit(stiffest[0], float(2.0 * np.sqrt(mass / total.max())))]


def _stiffest(scene: Scene, particles: Particles, assembly: Assembly) -> list[Limit]:
    """Return the bounds on the substep at the corner of the unknowns' bounds where the smallest of them is smallest.

    Every bound on the substep is monotone in every unknown. So the unknowns are set one after another: each to the end
    at which the smallest of the bounds that it changes is smaller. An unknown that changes no bound (such as a strength
    while its signal is zero) is set to the end farther from zero, and tried again after all others.
    """
    corner: dict[str, Array] = {}
    remaining = [path for path in scene.unknowns if assembly.reaches(path)]
    for _ in range(2):
        paths, remaining = remaining, []
        for path in paths:
            ends = sorted(scene.unknowns[path].bounds, key=abs, reverse=True)
            trials = [corner | {p: np.array(v) for p, v in tied(scene, path, end).items()} for end in ends]
            far, near = (_by_part(_limits(scene, particles, assembly, trial)) for trial in trials)
            changed = [part for part in far | near if far.get(part) != near.get(part)]
            least = [min((end.get(part, np.inf) for part in changed), default=0.0) for end in (far, near)]
            corner = trials[int(np.argmin(least))]
            remaining += [] if changed else [path]
    return _limits(scene, particles, assembly, corner)


def _by_part(limits: list[Limit]) -> dict[str, float]:
    """Return the smallest bound [s] of every part that has one."""
    least: dict[str, float] = {}
    for limit in limits:
        least[limit.part] = min(limit.dt, least.get(limit.part, np.inf))
    return least


def _limits_of_data(scene: Scene, particles: Particles, assembly: Assembly) -> list[Limit]:
    """Return the bounds of the scene variants of all recordings, which share one substep, and of the true values."""
    limits: list[Limit] = []
    if truth := _truth(scene):
        limits += _limits(scene, particles, assembly, truth)
    for recording in scene.recordings:
        if has_own_values(scene, recording):
            variant = scene_of_recording(scene, recording)
            particles = sample(variant)
            limits += _stiffest(variant, particles, Assembly(variant, particles))
    return limits


def _truth(scene: Scene) -> dict[str, Array]:
    """Return the true values of the synthetic data."""
    return {path: np.array(value) for path, value in truths(scene).items()}


def _possible(scene: Scene, limits: list[Limit]) -> list[Limit]:
    """Return bounds on the substep; raise a SceneError if one is too small for any run."""
    for limit in limits:
        if not limit.dt * MOST_SUBSTEPS >= scene.time.control_step:
            path = limit.part if "." in limit.part else ""
            message = (
                f"asks for substeps of {limit.dt:.3g} s, more than {MOST_SUBSTEPS:.0e} in a control step of "
                f"{scene.time.control_step:g} s: check its numbers and their units"
            )
            raise SceneError([Problem(scene.where(path), path, message), *unit_questions(scene)])
    return limits


def _check_substeps(scene: Scene, limits: list[Limit]) -> list[Problem]:
    """Raise a SceneError if the given substeps would blow up; return a warning if they nearly do, or are too many."""
    least = min(limits, key=lambda limit: limit.dt)
    dt = scene.time.control_step / int(scene.time.substeps)
    share = dt / least.dt
    if share <= WARN and (share >= WASTEFUL or scene.time.substeps == 1):
        return []
    needed = auto_substeps(scene.time.control_step, limits)
    message = (
        f"a substep of {dt:.3g} s is {share:.2g} of the largest stable one, {least.dt:.3g} s ({least.part}); "
        f"use {needed} substeps, or auto"
    )
    problem = Problem(scene.where("time.substeps"), "time.substeps", message)
    if share > REFUSE:
        raise SceneError([problem])
    return [problem]


def _check_corner(scene: Scene, limits: list[Limit]) -> list[Problem]:
    """Return a warning if the number of substeps is stable at the start, but too small at the unknowns' bounds."""
    least = min(limits, key=lambda limit: limit.dt)
    dt = scene.time.control_step / int(scene.time.substeps)
    if dt <= least.dt:
        return []
    message = (
        f"a substep of {dt:.3g} s is stable at the start, but {dt / least.dt:.3g} of the largest stable one at the "
        f"unknowns' bounds, {least.dt:.3g} s ({least.part}), where runs would blow up; use "
        f"{auto_substeps(scene.time.control_step, limits)} substeps, auto, or narrower bounds"
    )
    return [Problem(scene.where("time.substeps"), "time.substeps", message)]
