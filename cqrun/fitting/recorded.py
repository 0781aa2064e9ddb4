"""The cases of recordings, each with its own overrides, length and start."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cqrun.build.matter import matter_of
from cqrun.build.model import Built, build
from cqrun.build.values import numbers
from cqrun.errors import DataError, Problem, SceneError, UsageError
from cqrun.fitting.at_rest import rest_points
from cqrun.fitting.case import Case
from cqrun.measurements.at_rest import RestComparison
from cqrun.measurements.measurement import Recorded
from cqrun.measurements.placement import PLACED, Placement
from cqrun.measurements.window import Window
from cqrun.scene.data import Recording
from cqrun.scene.paths import canonical
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import body_of, bounds_of, own_unknowns, scene_of_recording, starts
from cqrun.scene.world_and_time import ON_CONTROL_STEP
from cqrun.store.recordings import read_recording


def recorded_cases(built: Built, specs: Mapping[str, Recording]) -> list[Case]:
    """Return the cases of all recordings; raise a SceneError with the problems of all of them."""
    cases, problems = [], []
    for name, spec in specs.items():
        try:
            cases.append(_recorded(built, name, spec))
        except SceneError as error:
            messages = [f"in its scene, {problem.path}: {problem.message}" for problem in error.problems]
            problems += [_problem(built, name, message) for message in messages]
        except UsageError as error:
            problems.append(_problem(built, name, str(error)))
    if problems:
        raise SceneError(problems)
    return cases


def _problem(built: Built, name: str, message: str) -> Problem:
    path = f"data.recordings.{name}"
    return Problem(built.scene.where(path), path, message)


def _recorded(built: Built, name: str, spec: Recording) -> Case:
    scene, path = built.scene, f"data.recordings.{name}.start"
    variant = _variant(built, name, spec)
    file = scene.resolve_path(spec.file)
    begins = starts(scene)  # the start and the placement may be unknowns, or follow one
    start = begins.get(path, spec.start)
    values = {path: np.asarray(value) for path, value in begins.items()}
    own = f"data.recordings.{name}"
    placement = Placement(*(numbers(f"{own}.{what}", getattr(spec, what), values) for what in PLACED))
    window = Window(
        scene.time.control_step, variant.model.n_controls, start, bounds_of(scene, path), spec.skip, source=str(file)
    )
    recorded = Recorded(
        file, spec.body, window, lambda names=None: read_recording(file, units=spec.units, names=names), spec.units,
        None if spec.still is None else (spec.still[0], spec.still[1]), spec.weight, placement,
    )  # fmt: skip
    comparison = spec.measurement.bind(recorded, matter_of(variant, {}))
    points: tuple[dict[str, float], ...] = ()
    if isinstance(comparison, RestComparison):
        points = rest_points(scene, name, variant, comparison)
        if placement.rotation.any() or any(what.startswith("rotation.") for what in own_unknowns(scene, name)):
            comparison.require_all_axes(file)
    return Case.probed(
        name,
        variant,
        (comparison,),
        start_path=path,
        start=start,
        placement=placement,
        holdout=spec.holdout,
        points=points,
    )


def _variant(built: Built, name: str, spec: Recording) -> Built:
    """Return the scene with a recording's overrides, unknowns and length."""
    scene, step = built.scene, built.scene.time.control_step
    length = scene.time.duration if spec.length is None else spec.length
    steps = round(length / step)
    if abs(steps * step - length) > ON_CONTROL_STEP * length:
        raise DataError(
            f"`length`, {length:.10g} s, is not a multiple of the control step {step:.10g} s; the nearest is "
            f"{max(1, steps) * step:.10g} s"
        )
    values = {**_signals(scene), **spec.overrides, "time.duration": steps * step}
    variant = build(scene_of_recording(scene, name, values))
    _require_same_particles(built, variant)
    return variant


def _signals(scene: Scene) -> dict[str, float]:
    """Return overrides that keep the scene's signals unchanged in a recording of another length."""
    signals = scene.activation
    return {} if signals is None or signals.over is not None else {"activation.over": scene.time.duration}


def _require_same_particles(built: Built, variant: Built) -> None:
    """Raise DataError if overrides change the particles of a body with an unknown per particle or field."""
    for path, unknown in built.scene.unknowns.items():
        for body in {body_of(built.scene, canonical(built.scene, p)) for p in (path, *unknown.also)} - {""}:
            if unknown.per in ("particle", "field"):
                ours, theirs = (b.particles.x[b.particles.of(body)] for b in (built, variant))
                if not np.array_equal(ours, theirs):
                    raise DataError(
                        f"its overrides change the particles of '{body}', and the unknown '{path}' has a value for "
                        "each of them: do not change the body's particles, or use `per: body`"
                    )
