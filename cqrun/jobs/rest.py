"""`cqrun rest`: find where a scene comes to rest, at one point or along a path of loads and activations; no time.

measurements.csv  the quantities that the scene measures, one row per point (store/measured.py)
rest.csv          one row per point: values of the path, how it was found, places of bodies and groups, reactions
trajectory.h5     x, v and J of every particle: frame 0 is the rest shape, then one frame per point
result.json       every point, findings
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np

from cqrun.actuators.chamber import is_chamber
from cqrun.build.check_frame import TOO_COARSE
from cqrun.build.check_holds import unheld_problems
from cqrun.build.history import remembering
from cqrun.build.load_path import idle_actuators, inputs_of, points_of
from cqrun.build.model import Built
from cqrun.build.thickness import thinnest_parts
from cqrun.engine.model import Inputs
from cqrun.engine.statics.equilibrium import Equilibrium
from cqrun.engine.statics.newton import Rest
from cqrun.engine.statics.path import Point, RestPath
from cqrun.engine.statics.touching import poses_at_rest
from cqrun.errors import Problem, SceneError, StopAsked
from cqrun.explain import listed
from cqrun.jobs.job import NO_FILES, Job
from cqrun.running.bodies import report_bodies, resolved_lines
from cqrun.running.extra_fields import ExtraFields
from cqrun.running.measuring import Measuring, measured_lines, write_measured
from cqrun.running.passing import Passing
from cqrun.running.reporter import Reporter
from cqrun.running.rest_table import RestTable, rest_frames, write_frame
from cqrun.running.runs import build_and_warn
from cqrun.running.tables import number, table
from cqrun.scene.load_path import ACTIVATION
from cqrun.scene.schema import Scene
from cqrun.store.rest_point import RestPoint
from cqrun.store.rest_points import delete_points, read_point, write_point
from cqrun.store.result import RestResult, write_result
from cqrun.store.rigid_motion import RigidMotions
from cqrun.store.run import RunDirectory

TOLERANCE = 1e-8
"""Net force divided by the loads at which a point counts as found."""

NEAR = 0.02
"""A smallest eigenvalue below this part of its largest along the path is reported: a limit point is near."""


MOTION = re.compile(r"bodies\.[^.]+\.((velocity|spin)\..*|material\.viscosity\..*)|loads\.[^.]+\.damping\..*")
"""Key paths that matter in motion alone."""


@dataclass(frozen=True)
class Resting:
    """A scene that is ready to rest, and the values of its points by key path."""

    built: Built
    points: tuple[dict[str, float], ...]
    threads: int


@dataclass(frozen=True)
class RestJob(Job[Resting, RestResult]):
    """Find the equilibria of a scene."""

    def prepare(self, scene: Scene, threads: int, talk: Reporter, files: Mapping[str, Path] = NO_FILES) -> Resting:
        """Build a scene, and refuse what needs time."""
        require_no_time(scene)
        built = build_and_warn(scene, talk)
        if unheld := unheld_problems(scene, built.particles, built.model.conditions):
            raise SceneError(unheld)
        points = tuple(points_of(built))
        found = [*_idle(scene), *_idle_along(built, points)]
        idle = [Problem(scene.where(path), path, message) for path, message in found]
        for problem in idle:
            talk.warn(str(problem))
        return Resting(replace(built, warnings=(*built.warnings, *idle)), points, threads)

    def reads_data(self, scene: Scene) -> bool:
        """Return False: rest reads no recordings."""
        return False

    def work(self, run: RunDirectory, prepared: Resting, talk: Reporter) -> None:
        """Find all points, from those that were found before."""
        built, points = prepared.built, prepared.points
        run.begin(prepared.threads)
        report_bodies(built, run, talk)
        count = f"{len(points)} point{'s' if len(points) > 1 else ''}"
        talk.phase(f"finding the rest of {built.model.layout.n_particles:,} particles: {count}")
        inputs = [inputs_of(built, point) for point in points]
        path = RestPath(built.model, inputs, threads=prepared.threads, tolerance=TOLERANCE, judge=True)
        found: list[RestPoint] = []
        rows, passing = RestTable(built, points), Passing(built)
        measuring, neutral = Measuring(built), built.assembly.actuation.neutral
        extra, rest_shape = ExtraFields(built), path.start.state(path.rest_shape)
        with rest_frames(run.path / "trajectory.h5", built, len(points)) as writer:
            write_frame(writer, rest_shape, 0, extra.at(rest_shape, inputs[0]))
            measuring.look(rest_shape, inputs[0], neutral)

            def observe(k: int, here: Equilibrium, point: Point) -> None:
                facts = _facts(point)
                write_point(run.path, k, point.rest.u, facts)
                found.append(RestPoint(values=points[k], **facts))
                if point.rest.converged:
                    state = here.state(point.rest.u)
                    rows.add(here, point.rest.u, facts)
                    passing.look(f"point {k + 1}", state)
                    write_frame(writer, state, k + 1, extra.at(state, inputs[k]))
                    measuring.look(state, inputs[k], inputs[k].activation[-1])
                rows.save(run.path / "rest.csv")
                talk.advance(k + 1, len(points), f"point {k + 1} of {len(points)}, {point.products} products")

            try:
                records = path.run(observe, lambda: talk.stop.asked, lambda k: _known(run.path, k))
            except StopAsked:
                writer.abandon()
                message = f"stopped after {len(found)} of {len(points)} points"
                run.finish("stopped", talk.stop.named(message))
                raise talk.stop.stopped(f"{message}; `cqrun resume {run.path}` goes on") from None
            measured = measuring.end(records, at_rest=True)
            if not found[-1].converged:
                writer.abandon()
            else:
                for beside in (measured, rigid_at_rest(built, inputs)):
                    if beside is not None:
                        writer.add(beside)
        unloaded = path.start.smallest_eigenvalue(path.rest_shape)
        self._end(run, built, found, [*passing.findings(), *_findings(found, unloaded)], measuring, talk)

    def _end(
        self, run: RunDirectory, built: Built, found: list[RestPoint], findings: list[str], measuring: Measuring,
        talk: Reporter,
    ) -> None:  # fmt: skip
        """Write the result."""
        lost = None if found[-1].converged else len(found)
        all_found = f"{len(found)} point{'s' if len(found) > 1 else ''} at rest"
        message = all_found if lost is None else _lost(found) + _burst(built)
        status = "done" if lost is None else "failed"
        for sentence in findings:
            talk.warn(sentence)
            run.log(sentence)
        result = RestResult(
            status=status, message=message, points=found, findings=findings, thinnest=thinnest_parts(built)
        )
        write_measured(run.path, measuring, result)
        write_result(run.path, result)
        if lost is None:
            delete_points(run.path)
        run.finish(status, message)

    def lines(self, run: Path, result: RestResult) -> Iterator[str]:
        """Yield every point."""
        yield f"{result.status}: {result.message}"
        yield ""
        keys = list(result.points[0].values) if result.points else []
        head = ("point", *keys, "residual", "steps", "products", "smallest eigenvalue")
        yield from table(head, [
            (str(k), *(number(p.values[key]) for key in keys), f"{p.residual:.1e}", str(p.steps), str(p.products),
             "-" if p.smallest is None else f"{p.smallest:.2e}") for k, p in enumerate(result.points, start=1)
        ])  # fmt: skip
        yield from measured_lines(result.measured)
        yield from resolved_lines(result.thinnest)
        yield from (f"note: {sentence}" for sentence in result.findings)

    @property
    def again(self) -> str:
        """What `cqrun resume` does with a run that was stopped."""
        return "goes on after the last point"


REST = RestJob("rest", RestResult, pictures=("bodies", "path", "measured"))


def rigid_at_rest(built: Built, inputs: Sequence[Inputs]) -> RigidMotions | None:
    """Return where rigid bodies are at the start and at every point, for pictures; None if there are none."""
    model = built.model
    if not model.rigid:
        return None
    rows = [poses_at_rest(model, each) for each in inputs]
    found = {body.name: np.array([0.0 * rows[0][body.name], *(row[body.name] for row in rows)]) for body in model.rigid}
    return RigidMotions(
        np.arange(len(rows) + 1.0), found, {body.name: body.center[: model.dim] for body in model.rigid}
    )


def require_no_time(scene: Scene) -> None:
    """Raise a SceneError for what has no meaning at rest."""
    if problems := [Problem(scene.where(path), path, message) for path, message in _needs_time(scene)]:
        raise SceneError(problems)


def _needs_time(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield what has no meaning at rest."""
    if scene.world.frame != "reference":
        yield "world.frame", "a body rests in the reference frame: set `world.frame: reference`"
    yield from _rubbing(scene)
    for path, name in remembering(scene):
        yield path, f"the stress of `{name}` has a history, and so no equilibrium: remove it, or use `cqrun simulate`"
    if scene.bodies_meet:
        yield "bodies", "bodies do not feel each other in an equilibrium yet: find that of one body alone"
    if scene.controller is not None:
        yield "controller", "a controller acts in time: remove it, and give activations in `path`"
    if scene.precision != "float64":
        yield "precision", TOO_COARSE.format(scene.precision)


def _rubbing(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield friction, which has no equilibrium of its own, and rigid bodies that are not where the scene says."""
    for name, chosen in scene.boundaries.items():
        path, spec = f"boundaries.{name}.{chosen.name}", cast(Any, chosen.value)
        if getattr(spec, "is_obstacle", False) and (getattr(spec, "coefficient", 0.0) > 0 or not spec.has_surface):
            yield path, "an equilibrium feels contact without friction alone: make it `separate`, `sticky` or `slip`"
        if getattr(spec, "to", None) is not None:
            yield f"{path}.to", "a patch cannot be glued to a rigid body at rest yet: give it a `displacement`"
    for name, measure in scene.measure.items():
        if measure.name == "rigid_motion":
            yield f"measure.{name}.{measure.name}", "a rigid body at rest is where the scene says: remove it"
    for name, body in scene.rigid.items():
        if body.free:
            yield (
                f"rigid.{name}.motion",
                "a rigid body at rest does not move freely: make it `fixed`, or give it a `path`",
            )
        if body.friction > 0 or f"rigid.{name}.friction" in scene.unknowns:
            yield f"rigid.{name}.friction", "an equilibrium feels contact without friction alone: set it to 0"


def _idle(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yield what the scene says about motion, and has no effect at rest."""
    for name, measure in scene.measure.items():
        if measure.value.needs_time:  # type: ignore[attr-defined]
            yield f"measure.{name}.{measure.name}", "says nothing at rest, where nothing moves"
    for name, body in scene.bodies.items():
        for key in ("velocity", "spin"):
            if any(getattr(body, key)):
                yield f"bodies.{name}.{key}", "has no effect at rest: `cqrun rest` finds where nothing moves"
        if "viscosity" in body.material.terms:
            yield f"bodies.{name}.material.viscosity", "has no effect at rest, where no velocity is"
    for name, chosen in scene.loads.items():
        if chosen.name == "damping":
            yield f"loads.{name}.damping", "has no effect at rest, where no velocity is"
    for name, chosen in scene.boundaries.items():
        if getattr(chosen.value, "over", None) is not None:
            path = f"boundaries.{name}.{chosen.name}.over"
            yield path, "has no effect at rest: `cqrun rest` carries the boundary to its place at once"


def _idle_along(built: Built, points: Sequence[dict[str, float]]) -> Iterator[tuple[str, str]]:
    """Yield what has no effect along the path: motion, and strengths of actuators that nothing activates."""
    keys = list(points[0])
    for key in keys:
        if MOTION.fullmatch(key):
            yield f"path.{key}", "has no effect at rest, where nothing moves"
    activated = [key.removeprefix(ACTIVATION).partition(".")[0] for key in keys if key.startswith(ACTIVATION)]
    for path, message in idle_actuators(built).items():
        if path.split(".")[1] not in activated:
            yield (f"path.{path}" if path in keys else path), message


def _facts(point: Point) -> dict[str, Any]:
    rest = point.rest
    smallest = _or_none(rest.smallest)
    residual = float(rest.residual) if np.isfinite(rest.residual) else 1e300
    return {
        "converged": rest.converged, "residual": residual, "steps": rest.steps, "products": point.products,
        "negative": rest.negative, "smallest": smallest, "halvings": point.halvings, "reached": float(point.reached),
        "rounded": rest.rounded, "jump": _or_none(point.jump), "jump_at": _or_none(point.jump_at),
    }  # fmt: skip


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _known(run: Path, k: int) -> Point | None:
    """Return a point that the run found before."""
    saved = read_point(run, k)
    if saved is None or not saved[1]["converged"]:
        return None
    u, f = saved
    rest = Rest(
        u, f["residual"], f["converged"], f["steps"], f["products"], f["negative"], f["smallest"], False,
        rounded=f["rounded"],
    )  # fmt: skip
    return Point(rest, f["reached"], f["halvings"], f["products"], f["jump"], f["jump_at"])


def _lost(found: list[RestPoint]) -> str:
    """Return why a path ended early."""
    last = found[-1]
    where = ", ".join(f"{key}={number(value)}" for key, value in last.values.items()) or "the loads of the scene"
    part = f"{100 * last.reached:.0f} % of the way to it"
    return (
        f"no equilibrium was found at point {len(found)} ({where}); {part} was covered: the body may buckle or collapse"
        " there (a limit point), or the load is too large for its material; smaller steps of `path` show where"
    )


def _burst(built: Built) -> str:
    """Return what a chamber under a given pressure may have to do with it."""
    names = [f"'{part.model.name}'" for part in built.assembly.actuation.parts if _is_regulated(part.spec)]
    if not names:
        return ""
    return (
        f"; or the chamber {listed(names)} bursts: its walls hold no larger pressure, as a balloon's beyond its limit "
        "point; with `gas` or `liquid` in place of `pressure`, `path` goes on beyond it"
    )


def _is_regulated(spec: Any) -> bool:
    return is_chamber(spec) and spec.pressure is not None


def _findings(found: list[RestPoint], unloaded: float) -> Iterator[str]:
    """Yield what a user should know about the points; `unloaded` is the smallest eigenvalue at the rest shape."""
    negative = [str(k) for k, p in enumerate(found, start=1) if p.negative and p.converged]
    if negative:
        yield (
            f"at point {', '.join(negative[:5])} the stiffness has a negative eigenvalue: the equilibrium is not "
            "stable, and a real body would leave it"
        )
    yield from (_snap(found, k) for k, p in enumerate(found) if p.jump is not None)
    values = [(unloaded, 0), *((p.smallest, k) for k, p in enumerate(found, start=1) if p.converged)]
    seen = [(value, k) for value, k in values if value is not None and np.isfinite(value)]
    for (before, k), (after, m) in pairwise(seen):
        if before > 0.0 >= after or after > 0.0 >= before:
            yield (
                f"between {'the rest shape' if k == 0 else f'point {k}'} and point {m} the smallest eigenvalue changes "
                f"from {before:.1e} to {after:.1e}: between them the body buckles, or has a limit point"
            )
    positive = [pair for pair in seen if pair[0] > 0.0]
    if len(positive) > 1:
        (least, at), most = min(positive), max(positive)[0]
        if least < NEAR * most and at > 0:
            yield (
                f"a limit point is near point {at}: the smallest eigenvalue of the stiffness fell to {least:.1e}, "
                f"{100 * least / most:.2g} % of its largest"
            )
    for k, p in enumerate(found, start=1):
        if p.rounded:
            yield (
                f"at point {k} rounding ended the search: the residual is {p.residual:.1e} of the loads, and not the "
                f"{TOLERANCE:.0e} that is asked for; a Poisson's ratio near 0.5 or very small loads do this, and "
                "gradients have errors of that size"
            )


def _snap(found: list[RestPoint], k: int) -> str:
    """Return the sentence on the jump of displacement before the point of this index."""
    point, before = found[k], found[k - 1].values if k else {}
    assert point.jump is not None
    assert point.jump_at is not None
    at = ", ".join(
        f"{key} = {number(before.get(key, 0.0) + point.jump_at * (value - before.get(key, 0.0)))}"
        for key, value in point.values.items()
    )
    return (
        f"on the way to point {k + 1}{f', near {at},' if at else ''} the body jumps: a part of it moves by "
        f"{number(point.jump)} m at once, to another branch of equilibria, as a body that snaps through or folds; "
        "the points after it are on that branch, and `cqrun simulate` shows the motion"
    )
