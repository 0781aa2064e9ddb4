"""The bounds of a scene on its substep: at some values, at the worst corner of its unknowns, and of its recordings."""

from __future__ import annotations

import numpy as np

from cqrun.build.actuation import Actuation
from cqrun.build.assembly import Assembly
from cqrun.build.check_units import unit_questions
from cqrun.build.contact import contact_limits, stiffest_contact
from cqrun.build.limits import (
    MOST_SUBSTEPS,
    REFUSE,
    WARN,
    Limit,
    auto_substeps,
    motion_limit,
    push_limit,
    wave_limit,
)
from cqrun.build.particles import Particles, sample
from cqrun.build.pulled import pull_limits
from cqrun.build.rigid import rigid_limits
from cqrun.errors import Problem, SceneError
from cqrun.plugin.contract import Array
from cqrun.plugin.reference import body_of
from cqrun.scene.paths import with_values
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import has_own_values, scene_of_recording, start, tied, truths

WASTEFUL = 1e-3
"""A substep smaller than this part of the largest stable one is probably a mistake."""


def with_substeps(
    scene: Scene, particles: Particles, assembly: Assembly
) -> tuple[Scene, list[Limit], list[Limit], list[Problem]]:
    """Return the scene with its number of substeps, the bounds at the worst corner and for what it runs, and warnings.

    Raises:
        SceneError: a bound is too small for any run, or the given number of substeps.
    """
    limits = _possible(scene, _stiffest(scene, particles, assembly))
    if scene.time.substeps == "auto":
        bounds = [*limits, *_possible(scene, _limits_of_data(scene, particles, assembly))]
        chosen = with_values(scene, {"time.substeps": auto_substeps(scene.time.control_step, bounds)})
        return chosen, limits, bounds, []
    reached = [path for path in scene.unknowns if assembly.reaches(path)]
    starts = {p: np.array(v) for path in reached for p, v in tied(scene, path, start(scene, path)).items()}
    bounds = _possible(scene, _limits(scene, particles, assembly, starts))
    if truth := _truth(scene):
        bounds += _possible(scene, _limits(scene, particles, assembly, truth))
    doubts = _check_substeps(scene, _certain(bounds)) or _check_corner(scene, _certain(limits))
    return scene, limits, bounds, doubts or _check_pulls(scene, bounds)


def stable(scene: Scene, particles: Particles, assembly: Assembly, values: dict[str, Array]) -> tuple[Limit, int]:
    """Return the smallest bound on the substep for values by path, and the number of substeps that `auto` would give.

    Raises:
        SceneError: the bound is too small for any run.
    """
    limits = _certain(_possible(scene, _limits(scene, particles, assembly, values)))
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
        limits += pull_limits(scene, particles, assembly, name, density, modulus, values)
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

    Bounds on the substep are monotone in every unknown, but for those of bodies that are pulled far. So the unknowns
    are set one after another: each to the end at which the smallest of the bounds that it changes is smaller. An
    unknown that changes no bound (such as a strength while its signal is zero) is set to the end farther from zero, and
    tried again after all others.
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
            path = limit.part.partition(" ")[0] if "." in limit.part else ""
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


def _certain(limits: list[Limit]) -> list[Limit]:
    """Return the bounds that are no estimates."""
    return [limit for limit in limits if not limit.estimated]


def _check_pulls(scene: Scene, limits: list[Limit]) -> list[Problem]:
    """Return a warning if the given substeps are too few for a body where clamps have pulled it."""
    least = min((limit for limit in limits if limit.estimated), key=lambda limit: limit.dt, default=None)
    dt = scene.time.control_step / int(scene.time.substeps)
    if least is None or dt <= least.dt:
        return []
    message = (
        f"a substep of {dt:.3g} s is stable at the start, but waves need {least.dt:.3g} s ({least.part}), where the "
        f"run may blow up; use {auto_substeps(scene.time.control_step, limits)} substeps, or auto"
    )
    return [Problem(scene.where("time.substeps"), "time.substeps", message)]


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
