"""`cqrun validate`: check a scene, and report what is known before it runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import prod
from pathlib import Path

from cqrun.build.check_grid import nearest_nodes
from cqrun.build.check_units import in_si
from cqrun.build.load_path import points_of
from cqrun.build.measures import bound_measures
from cqrun.build.model import Built
from cqrun.build.thickness import thinnest_parts
from cqrun.engine.frames import make_rollout
from cqrun.engine.model import ConditionModel
from cqrun.errors import SceneError, UsageError
from cqrun.explain import listed
from cqrun.fitting.case import Case
from cqrun.fitting.cases import given_cases, is_fit, recording_warnings
from cqrun.jobs.control import CODESIGN, CONTROL
from cqrun.jobs.gradcheck import at_rest
from cqrun.jobs.rest import REST
from cqrun.jobs.sysid import SYSID, with_optimizer
from cqrun.jobs.table import JOBS
from cqrun.learning.agent import Agent
from cqrun.learning.description import control_lines, line, objective_lines
from cqrun.learning.episodes import EpisodeProblem, differentiated, has_episodes
from cqrun.materials.moduli import at_rest_words
from cqrun.measurements.placement import PLACED
from cqrun.running.bodies import lies, made_of, on_particles, resolved, rounding_of
from cqrun.running.cost import (
    NANOSECONDS,
    OUTPUT,
    START,
    duration,
    forward_seconds,
    gradient_seconds,
    picture_seconds,
)
from cqrun.running.gradient_memory import GRADIENT, gradient_plan
from cqrun.running.reporter import Silent
from cqrun.running.runs import build_and_warn, optimizer_of
from cqrun.running.tables import number
from cqrun.running.trajectories import count_frames
from cqrun.scene.load import load_scene
from cqrun.scene.paths import leaf
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import own_unknowns, start
from cqrun.store.result import LEARNED
from cqrun.store.thinnest import Thinnest
from cqrun.units import format_bytes

MILLI = 1e3


def validate(scene_path: Path, overrides: Sequence[str] = ()) -> Iterator[str]:
    """Yield lines on a scene: particles, masses, time step, memory, data, cost.

    Raises:
        SceneError, UsageError: the scene cannot be run.
    """
    built, agent, episodes, cases = _prepared(load_scene(scene_path, overrides))
    scene = built.scene
    yield f"{scene_path}: a valid scene" + (f": {scene.title}" if scene.title else "")
    yield from _world(built)
    thinnest = thinnest_parts(built)
    for name in built.particles.names:
        yield from _body(built, name, thinnest[name])
    yield from _rigid(built)
    yield from _regions(built)
    yield from _actuators(built)
    yield from _measured(built)
    yield from _rest(built) if at_rest(scene) else _time(built)
    if built.scene.unknowns:
        yield from _unknowns(built)
    yield from _data(built, cases)
    if agent is not None:
        yield from control_lines(agent, episodes)
    if not at_rest(scene):
        yield from _cost(built, episodes)
    for warning in (*built.warnings, *recording_warnings(built, cases or [])):
        yield f"warning: {warning}"


def _prepared(scene: Scene) -> tuple[Built, Agent | None, EpisodeProblem | None, list[Case] | None]:
    """Return the scene, its agent, its episodes and its cases; each of the last three may be None."""
    if scene.job in LEARNED or has_episodes(scene):
        problem = (CODESIGN if scene.job == CODESIGN.name else CONTROL).prepare(scene, 1, Silent())
        return problem.built, problem.agent, problem, None
    if _fits(scene):
        fit = SYSID.prepare(scene, 1, Silent())
        return fit.built, None, None, fit.cases
    if scene.job == REST.name:
        return REST.prepare(scene, 1, Silent()).built, None, None, None
    built = build_and_warn(scene, Silent())
    agent = None if scene.controller is None else Agent(built)
    reads_data = scene.job is None or JOBS[scene.job].reads_data(scene)
    return built, agent, None, given_cases(built) if reads_data else None


def _fits(scene: Scene) -> bool:
    """Return whether a scene is for sysid."""
    with_data = bool(scene.unknowns) and scene.data is not None
    return scene.job == "sysid" or (scene.job is None and (with_data or is_fit(scene)))


# --- the world and what is in it ----------------------------------------------------------------------------


def _world(built: Built) -> Iterator[str]:
    world, shape = built.scene.world, built.model.grid_shape
    size = " x ".join(number(edge) for edge in world.size)
    nodes = " x ".join(map(str, shape))
    yield line("world", f"{size} m in cells of {number(world.dx)} m: {nodes} = {prod(shape):,} nodes")
    if not in_si(built.scene):
        yield line("units", "gravity or stiffness is unlike that in SI units, but labels name SI units even so")
    held = ", ".join(f"{c.name} ({c.spec.name}, {_held(built, c)})" for c in built.model.conditions)
    yield line("boundaries", held or "none: a body that reaches the edge of the world stops the run")
    for name, center in built.model.centers.items():
        yield line("", f"moments of '{name}' are about ({', '.join(map(number, center))}) m")


def _held(built: Built, condition: ConditionModel) -> str:
    """Return the number of nodes of a boundary, and of particles with one of them as their nearest node, as text.

    In the reference frame, an obstacle holds no nodes: points of the bodies' surfaces touch it.
    """
    if built.model.surface is not None and condition.spec.is_obstacle:
        return f"touched by {len(built.model.surface.x):,} points of surfaces"
    nearest = nearest_nodes(built.particles.x, built.model.grid_shape, built.model.dx)
    nodes, particles = int(condition.nodes.sum()), int(condition.nodes[nearest].sum())
    return f"{nodes:,} nodes" + (f", {particles:,} particle{'s' * (particles != 1)}" if particles else "")


def _body(built: Built, name: str, thinnest: Thinnest) -> Iterator[str]:
    yield line(f"body {name}", made_of(built, name))
    yield line("", lies(built, name))
    yield line("", resolved(thinnest))
    for place, material in built.scene.bodies[name].materials.items():
        if material.elastic is not None and (words := at_rest_words(material.elastic.value)):
            region = place.partition(".")[2]
            yield line("", f"{material.elastic.name}{' of ' * bool(region)}{region}: {words}")
    groups = [f"{group} {len(members):,}" for group, members in built.particles.groups(name).items()]
    if groups:
        yield line("", f"groups: {listed(groups)}")


def _rigid(built: Built) -> Iterator[str]:
    """Yield a line per rigid body: how it moves, its mass and what of it can touch."""
    unit = "kg" if built.scene.dim == 3 else "kg/m"
    for model, (name, mass) in zip(built.model.rigid, built.assembly.rigid.masses({}).items(), strict=True):
        body, center = built.scene.rigid[name], ", ".join(map(number, model.center[: built.scene.dim]))
        motion = f"on a path through {len(body.waypoints)} places" if body.path else "fixed"
        if body.free:
            motion = f"free, mass {number(mass)} {unit}, {len(model.skin):,} points of its skin touch boundaries"
        yield line(f"rigid {name}", f"{body.shape.name}, {motion}")
        yield line("", f"centre at ({center}) m, friction {number(body.friction)}")


def _regions(built: Built) -> Iterator[str]:
    """Yield a line per region of the scene with the particles that are in it."""
    for name, chosen in built.scene.regions.items():
        counts = {}
        for body, points in built.particles.points.items():
            try:
                counts[body] = int(points.pick(chosen).sum())
            except UsageError:  # such as a colour, of a body that is not made from an image
                continue
        found = [f"{count:,} particle{'s' * (count != 1)} of '{body}'" for body, count in counts.items() if count]
        yield line("region", f"{name}: {listed(found) if found else 'no particle'}")


def _actuators(built: Built) -> Iterator[str]:
    for part in built.assembly.actuation.every:
        section, _, kind = part.path.split(".")
        yield line(section[:-1], f"{part.model.name} ({kind}): {on_particles(built, part)}")


def _measured(built: Built) -> Iterator[str]:
    for name, bound in bound_measures(built).items():
        numbers = [component for component in bound.components if component]
        unit = "" if bound.unit == "1" else f" [{bound.unit}]"
        yield line("measured", f"{name}: {bound.meaning}{unit}{f', {listed(numbers)}' if numbers else ''}")


# --- time ---------------------------------------------------------------------------------------------------


def _time(built: Built) -> Iterator[str]:
    time, model = built.scene.time, built.model
    yield line(
        "time",
        f"{number(time.duration)} s in {model.n_controls} control steps of {number(time.control_step)} s, "
        f"each of {model.substeps} substeps of {number(model.dt)} s: {model.n_steps:,} substeps",
    )
    least = min(built.limits, key=lambda limit: limit.dt)
    corner = " at the worst corner of the unknowns' bounds" if built.scene.unknowns else ""
    cause = f"{number(least.dt)} s ({least.part}{corner})"
    yield line("", f"{model.dt / least.dt:.2f} of the largest stable substep, {cause}")
    if rounding := rounding_of(built):
        yield line("", rounding)
    for limit in built.limits:
        if limit is not least:
            yield line("", f"limit of {limit.part}: {number(limit.dt)} s")


def _rest(built: Built) -> Iterator[str]:
    """Yield what matters at rest: the points, and the size of the system of each."""
    points, dim = points_of(built), built.model.dim
    along = f", along {listed(points[0])}" if points[0] else ", under the loads of the scene"
    yield line("rest", f"{len(points)} point{'s' * (len(points) != 1)}{along}")
    yield line("", f"{dim * built.model.n_nodes:,} displacements of {built.model.n_nodes:,} nodes in each")


# --- unknowns and data --------------------------------------------------------------------------------------


def _unknowns(built: Built) -> Iterator[str]:
    scene = built.scene
    for path, unknown in scene.unknowns.items():
        low, high = unknown.bounds
        unit = leaf(scene, path).unit
        unit = "" if unit == "1" else f" {unit}"
        per = {"body": "", "field": ", a smooth field"}.get(unknown.per, f", one per {unknown.per}")
        per += "" if unknown.mirror is None else f", mirrored across {unknown.mirror}"
        text = f"{path}: {number(low)} to {number(high)}{unit}, from {number(start(scene, path))}"
        yield line("unknown", f"{text}, {unknown.scale} scale{per}")
    if not scene.predicts_only and (scene.data is not None or _fits(scene)):
        chosen = with_optimizer(scene).optimizer
        assert chosen is not None
        yield line("optimizer", f"{chosen.name}, at most {chosen.value.max_iterations} iterations")  # type: ignore[attr-defined]


def _data(built: Built, cases: list[Case] | None) -> Iterator[str]:
    made = built.scene.synthetic
    if made is not None:
        points = f"{len(made.markers)} markers" if made.markers is not None else f"{made.tracked} tracked particles"
        yield line(
            "data",
            f"synthetic: {built.scene.sequences} x {made.copies} recordings of {points} on '{made.body}', "
            f"noise {number(MILLI * made.noise)} mm",
        )
    if cases and built.scene.predicts_only:
        kept = ", also for the unknowns" if built.scene.unknowns else ""
        yield line("fit", f"none: every recording is held out, so sysid predicts them with the scene's values{kept}")
    for case in cases or []:
        yield from _recording(built.scene, case) if built.scene.data is not None else objective_lines(built.scene)


def _recording(scene: Scene, case: Case) -> Iterator[str]:
    use = "held out" if case.holdout else "fitted"
    for comparison in case.comparisons:
        yield line("recording", f"{case.name} ({use}): {comparison.summary()}")
        if comparison.remark:
            yield line("", comparison.remark)
    if fitted := own_unknowns(scene, case.name):
        yield line("", f"fitted for this recording alone: {listed(fitted)}")
    recording = scene.recordings.get(case.name)
    placed = [what for what in PLACED if recording is not None and any(getattr(recording, what))]
    if recording is not None and (given := [*recording.overrides, *placed]):
        yield line("", f"given for this recording alone: {listed(given)}")


# --- cost ---------------------------------------------------------------------------------------------------


def _cost(built: Built, learned: EpisodeProblem | None) -> Iterator[str]:
    model = built.model
    size, budget = model.state_bytes, format_bytes(model.memory_budget)
    forward = forward_seconds(model)
    try:
        plan, because = gradient_plan(built), ""
        if model.frame == "reference":
            rollout = make_rollout(model, built.assembly.inputs({}), adjoint=True)
            plan, because = rollout.expected_plan(), rollout.kept_because
    except SceneError as error:  # the scene can still be run forward
        yield f"warning: no gradients: {error}"
        yield line("cost", f"an estimate, for one core: {duration(forward)} forward")
        return
    again = "no substep runs twice" if plan.recompute == 1 else f"{plan.recompute:.2f} forward substeps for each"
    yield line(
        "memory",
        f"a gradient {'runs the motion backwards and ' if plan.backwards else ''}keeps {plan.states:,} states of "
        f"{format_bytes(size)}, {format_bytes(plan.states * size)} of a budget of {budget}"
        f"{f', because {because}' if because else ''}: {again}",
    )
    backward = gradient_seconds(model)
    yield line(
        "cost",
        f"an estimate, for one core: {duration(forward)} forward, {duration(backward)} with the gradient "
        f"({NANOSECONDS[model.dim]:g} ns per particle and substep; `cqrun bench` measures this machine)",
    )
    if learned is not None:
        optimizer = optimizer_of(built.scene)
        if optimizer.gradients:
            episodes = min(learned.n_episodes, getattr(optimizer, "batch_size", None) or learned.n_episodes)
            of = f"{episodes} {'episode' if episodes == 1 else 'episodes'} with the gradient"
            constraints = differentiated(learned) - 1
            sweeps = constraints * (GRADIENT - 1.0) * forward
            if constraints:
                of += f" and the gradients of {constraints} constraint{'s' if constraints > 1 else ''}"
            once, most = ("a trial", "at most ") if constraints else ("an iteration", "")
            each = episodes * (backward + sweeps)
            yield line("", f"{once} of {optimizer.name}: {of}, {most}{duration(each)}")
            if not constraints:
                count = optimizer.max_iterations
                yield _whole_run(built, f"a whole run of {count} iterations", count * each)
        else:
            of = f"{learned.n_episodes} {'episode' if learned.n_episodes == 1 else 'episodes'} forward"
            yield line("", f"a trial of {optimizer.name}: {of}, {duration(learned.n_episodes * forward)}")
    elif not _fits(built.scene):
        yield _whole_run(built, "a whole simulation", forward)


def _whole_run(built: Built, name: str, seconds: float) -> str:
    """Return a line on the time of a whole run, whose rollouts take `seconds`."""
    model = built.model
    drawing = picture_seconds(model.dim, model.layout.n_particles, count_frames(built))
    whole = START + seconds + OUTPUT * model.n_controls + drawing
    parts = f"{duration(START)} to start and {duration(drawing)} for pictures and report, as measured on one machine"
    return line("", f"{name}: about {duration(whole)}, with {parts}, but without compiling kernels")
