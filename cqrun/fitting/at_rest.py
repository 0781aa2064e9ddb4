"""Check that a recording at rest fits its scene, before anything is run: loads, clamps, frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from cqrun.build.check_holds import held_problem
from cqrun.build.history import remembering
from cqrun.build.load_path import checked_key, idle_actuators, inputs_of
from cqrun.build.model import Built
from cqrun.engine.reference.rest import rest_geometry
from cqrun.engine.statics.path import RestPath
from cqrun.errors import DataError, NoRestError, Problem, SceneError
from cqrun.explain import listed
from cqrun.fitting.case import Case
from cqrun.fitting.runners import AtRest
from cqrun.measurements.at_rest import RestComparison
from cqrun.plugin.contract import Array
from cqrun.scene.keypath import split_own
from cqrun.scene.load_path import MOST_POINTS
from cqrun.scene.paths import canonical
from cqrun.scene.schema import Scene

LEAST_MOVED = 0.05
"""A marker with less weight on particles that can move counts as clamped."""


def rest_points(scene: Scene, name: str, built: Built, comparison: RestComparison) -> tuple[dict[str, float], ...]:
    """Return the loads of a recording's points by the long form of their key paths.

    Args:
        scene: with the unknowns of the fit.
        name: of the recording.
        built: the scene of the recording.

    Raises:
        SceneError, DataError: something does not fit.
    """
    if problems := list(_unsuited(built.scene, name, comparison)):
        raise SceneError([Problem(scene.where(path), path, message) for path, message in problems])
    if len(comparison.points) > MOST_POINTS:
        raise DataError(f"has {len(comparison.points):,} points, more than {MOST_POINTS:,}")
    long = {}
    for key, column in comparison.loads.items():
        where = f"data.recordings.{name}.{comparison.spec.name}.loads.{column}"
        long[key] = checked_key(built, key, where, [point[key] for point in comparison.points])
        if message := _fitted(scene, name, long[key]) or idle_actuators(built).get(long[key]):
            raise SceneError([Problem(scene.where(where), where, message)])
    points = tuple({long[key]: value for key, value in point.items()} for point in comparison.points)
    _require_free(built, comparison)
    _require_held(built, points)
    return points


def questions(case: Case, values: Mapping[str, Array]) -> Iterator[str]:
    """Yield what is probably wrong with a case's data, as a few equilibria with some values by path show."""
    for comparison in case.comparisons:
        if isinstance(comparison, RestComparison) and comparison.telling:
            points = tuple(case.points[k] for k in comparison.telling)
            try:
                records = AtRest(case.built, points).run(case.own_values(values))
            except NoRestError:
                continue
            yield from comparison.questions_at(records)


def _unsuited(scene: Scene, name: str, comparison: RestComparison) -> Iterator[tuple[str, str]]:
    """Yield what a scene has that equilibria cannot have."""
    kind = comparison.spec.name
    if scene.world.frame != "reference":
        yield (
            "world.frame",
            f"is `{scene.world.frame}`, but the recording '{name}' (`{kind}`) is compared with bodies at rest, which "
            "only the reference frame has: set `world.frame: reference`",
        )
    for path, term in remembering(scene):
        yield (
            path,
            f"the stress of `{term}` has a history, and so no equilibrium, but the recording '{name}' (`{kind}`) is "
            "compared with bodies at rest: remove one of the two",
        )
    if scene.precision != "float64":
        yield "precision", f"is `{scene.precision}`, too coarse for bodies at rest (`{kind}`): use float64"


def _fitted(scene: Scene, name: str, load: str) -> str:
    """Return what is wrong if a load is an unknown of the fit, or follows one; empty if it is not."""
    for unknown, spec in scene.unknowns.items():
        for path in (unknown, *spec.also):
            recording, inside = split_own(canonical(scene, path))
            if inside == load and recording in ("", name):
                return f"its values are those of '{load}', which the unknown '{unknown}' sets: remove one of the two"
    return ""


def _require_held(built: Built, points: Sequence[Mapping[str, float]]) -> None:
    """Raise a SceneError for bodies that nothing holds."""
    scene = built.scene
    loose = RestPath(built.model, [inputs_of(built, points[0])]).loose
    if loose:
        raise SceneError([held_problem(scene, body, ways) for body, ways in loose.items()])


def _require_free(built: Built, comparison: RestComparison) -> None:
    """Raise a DataError for channels whose particles cannot move."""
    if comparison.rows.shape[0] != len(comparison.names):
        return
    clamped = clamped_particles(built)
    rows = comparison.rows
    moved = abs(rows) @ ~clamped / abs(rows).sum(axis=1)
    stuck = [name for name, part in zip(comparison.names, moved, strict=True) if part < LEAST_MOVED]
    if stuck:
        which = f"marker '{stuck[0]}' is" if len(stuck) == 1 else f"markers {listed(stuck)} are"
        raise DataError(
            f"{which} bound to a part of the body that is clamped, so the model cannot move it: correct its rest "
            "position, or remove it from `markers`"
        )


def clamped_particles(built: Built) -> Array:
    """Return the particles that cannot move (N,) of bool: every node around them is in a `sticky` boundary."""
    model = built.model
    rest = rest_geometry(model, built.particles.x)
    clamps = sum(1 << k for k, condition in enumerate(model.conditions) if condition.spec.name == "sticky")
    nodes, _ = rest.weights(rest.patches.layout.columns())
    return np.asarray((rest.held(model).bits[nodes] & clamps != 0).all(axis=1))
