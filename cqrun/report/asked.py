"""Section: what a scene asks for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cqrun.explain import listed
from cqrun.materials.moduli import at_rest_words
from cqrun.plugin.choice import Chosen
from cqrun.report.blocks import Block, Facts
from cqrun.report.subject import Subject
from cqrun.report.words import clipped, count, short, some, unit_text
from cqrun.scene.body import Body
from cqrun.scene.load_path import PathValues, Ramp
from cqrun.scene.rigid import RigidBody
from cqrun.scene.schema import Scene

JOBS = {
    "sysid": "identification of unknowns from data",
    "control": "training of a controller",
    "codesign": "design of a body together with its controller",
    "simulate": "simulation",
    "rest": "equilibria under loads",
    "gradcheck": "check of the gradient against finite differences",
}
"""What each job does."""


def task(subject: Subject) -> str:
    """Return what a run does, in words."""
    scene, job = subject.run.scene, subject.run.job
    if job == "sysid" and scene.predicts_only:
        return "prediction of recordings that are held out"
    return JOBS.get(job, job)


def asked(subject: Subject) -> Iterator[Block]:
    """Yield the scene in words: bodies, what acts on them, unknowns, data, objective."""
    yield Facts([(name, clipped(text, 1000)) for name, text in _facts(subject) if text])


def _facts(subject: Subject) -> Iterator[tuple[str, str]]:
    scene = subject.run.scene
    yield "Task", task(subject)
    yield "World", _world(scene)
    yield "Bodies", "; ".join(_body(name, body) for name, body in list(scene.bodies.items())[:12])
    yield "Materials", some(_laws(scene), between="; ")
    yield "Boundaries", _plugins(scene.boundaries)
    yield "Rigid bodies", some(f"{name} ({_motion(body)})" for name, body in scene.rigid.items())
    yield "Loads", _plugins(scene.loads)
    yield "Forces", _plugins(scene.forces)
    yield "Actuators", _plugins(scene.actuators)
    if subject.run.job == "rest":
        yield "Path", some((f"{key}: {_path(values)}" for key, values in scene.path.items()), between="; ")
    else:
        substeps = "" if scene.time.substeps == "auto" else f", {count(scene.time.substeps, 'substep')} each"
        steps = f"control steps of {short(scene.time.control_step)} s{substeps}"
        yield "Time", f"{short(scene.time.duration)} s in {scene.time.control_steps:,} {steps}"
    yield "Unknowns", some((_unknown(subject, path) for path in scene.unknowns), between="; ")
    yield "Data", _data(scene)
    yield "Observers", _plugins(scene.observers)
    yield "Controller", "" if scene.controller is None else scene.controller.name
    yield "Goals", some(f"{name} at {point(goal.position)} m" for name, goal in scene.goals.items())
    yield "Objective", _plugins(scene.objective)
    yield "Constraints", _constraints(scene)
    if scene.optimizer is not None:
        most = getattr(scene.optimizer.value, "max_iterations", None)
        yield "Optimizer", scene.optimizer.name + ("" if most is None else f", at most {count(most, 'iteration')}")


def _world(scene: Scene) -> str:
    world = scene.world
    size = " x ".join(short(edge) for edge in world.size)
    gravity = f", gravity {point(world.gravity)} m/s²" if any(world.gravity) else ", no gravity"
    return f"{scene.dim}D, {size} m, cells of {short(world.dx)} m{gravity}, frame: {world.frame}"


def _laws(scene: Scene) -> Iterator[str]:
    """Yield the laws of bodies and regions with their moduli at rest, each once with the places that have it."""
    found: dict[str, list[str]] = {}
    for name, body in scene.bodies.items():
        for place, material in body.materials.items():
            if material.elastic is not None and (words := at_rest_words(material.elastic.value)):
                where = ".".join([clipped(name, 60), *place.split(".")[1:]])
                found.setdefault(f"{material.elastic.name}: {words}", []).append(where)
    for law, places in found.items():
        yield law if len(found) == 1 else f"{listed(places, 8)}: {law}"


def _body(name: str, body: Body) -> str:
    material = body.material
    law = ", ".join([material.elastic.name, *material.terms])
    shape = "" if body.shape is None else f"{body.shape.name}, "
    parts = "" if body.parts is None else f"{count(len(body.parts), 'part')}, "
    return f"{clipped(name, 60)} ({shape}{parts}{law}, {short(material.density)} {unit_text('kg/m^3')})"


def _plugins(chosen: Mapping[str, Chosen[Any]]) -> str:
    return some(name if name == of.name else f"{name} ({of.name})" for name, of in chosen.items())


def _motion(body: RigidBody) -> str:
    return "on a path" if body.path else body.motion


def _path(values: PathValues) -> str:
    numbers = values.values if isinstance(values, Ramp) else values
    first, last = short(numbers[0]), short(numbers[-1])
    return first if len(numbers) == 1 else f"{first} to {last} ({len(numbers)} values)"


def _unknown(subject: Subject, path: str) -> str:
    spec = subject.run.scene.unknowns[path]
    low, high = (short(end) for end in spec.bounds)
    each = "" if spec.per == "body" else f", one per {spec.per}" if spec.per != "field" else ", a field"
    scale = ", log scale" if spec.scale == "log" else ""
    return f"{path} between {low} and {high} {unit_text(subject.unit(path))}".rstrip() + each + scale


def _data(scene: Scene) -> str:
    if scene.synthetic is not None:
        noise = short(1e3 * scene.synthetic.noise)
        truth = some(f"{path} = {short(value)}" for path, value in scene.synthetic.truth.items())
        return f"synthetic, with noise of {noise} mm, made with {truth}"
    return some(
        f"{name} ({recording.measurement.name}{', held out' if recording.holdout else ''})"
        for name, recording in scene.recordings.items()
    )


def _constraints(scene: Scene) -> str:
    words = {"at_least": "at least", "at_most": "at most", "equals": "equal to"}
    each = []
    for name, constraint in scene.constraints.items():
        ends = [f"{words[end]} {short(v)}" for end in words if (v := getattr(constraint, end)) is not None]
        each.append(f"{name} ({constraint.of.name}) {' and '.join(ends)}")
    return some(each)


def point(x: list[float]) -> str:
    """Return a position or vector as text."""
    return "(" + ", ".join(short(c) for c in x) + ")"
