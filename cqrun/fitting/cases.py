"""Cases: the rollouts that a fit compares with data, one a recording or a sequence of activations, or one a wish.

A case is the scene with a recording's overrides and length, its model, and what its records are compared with.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from cqrun.build.model import Built
from cqrun.errors import Problem, RolloutError, RunError, SceneError
from cqrun.fitting.case import Case
from cqrun.fitting.recorded import recorded_cases
from cqrun.fitting.synthetic import synthetic_cases
from cqrun.fitting.wanted import wanted_case
from cqrun.running.runs import data_files
from cqrun.scene.schema import Scene
from cqrun.store.run import RunDirectory


def is_fit(scene: Scene) -> bool:
    """Say whether a scene has unknowns and, without a controller, what they are fitted to: data or an objective."""
    return bool(scene.unknowns) and scene.controller is None and (scene.data is not None or bool(scene.objective))


def make_cases(built: Built, directory: Path | None = None) -> list[Case]:
    """Return the cases of a scene's data or, without any, of its objective.

    Args:
        built: the scene, its substeps resolved.
        directory: where synthetic data is kept; without one it is made in memory.

    Raises:
        SceneError: data, or an objective, that cannot be used.
    """
    data = built.scene.data
    if data is None and built.scene.objective:
        return [wanted_case(built)]
    if data is None:
        where = built.scene.where("")
        raise SceneError([Problem(where, "data", "there is none: give `recordings` or `synthetic`")])
    if data.recordings is not None:
        return recorded_cases(built, data.recordings)
    assert data.synthetic is not None
    return synthetic_cases(built, data.synthetic, directory)


def given_cases(built: Built) -> list[Case] | None:
    """Return the cases of recordings, or of an objective; None where there are none, or the run makes its own data.

    Read before there is a run: one whose data cannot be used leaves nothing behind.

    Raises:
        SceneError: data that is missing or cannot be used, or of which nothing is fitted.
    """
    scene = built.scene
    if scene.synthetic is not None or (scene.data is None and not is_fit(scene)):
        return None
    data_files(scene)  # all that are missing are told at once
    cases = make_cases(built)
    if all(case.holdout for case in cases):
        message = "every recording is held out: nothing is left to fit"
        raise SceneError([Problem(scene.where("data.recordings"), "data.recordings", message)])
    return cases


def own_warnings(built: Built, cases: Sequence[Case]) -> Iterator[str]:
    """Yield the warnings of recordings' own scenes that are not the scene's, and what looks wrong in recordings."""
    told = {warning.message for warning in built.warnings}
    for case in cases:
        yield from (f"{case.name}: {warning}" for warning in case.built.warnings if warning.message not in told)
        yield from (f"{case.name}: {doubt}" for comparison in case.comparisons for doubt in comparison.doubts)


def remarks(cases: Sequence[Case]) -> Iterator[str]:
    """Yield a sentence on how each recording was taken."""
    for case in cases:
        yield from (f"{case.name}: {comparison.remark}" for comparison in case.comparisons if comparison.remark)


def made_cases(run: RunDirectory, built: Built) -> list[Case]:
    """Return the cases of the data that a run makes with the true values.

    Raises:
        RunError: the scene blows up with them.
    """
    try:
        return make_cases(built, run.path)
    except RolloutError as error:
        run.finish("failed", f"data.synthetic.truth: {error}")
        raise RunError(f"{run.path}: data.synthetic.truth: {error}") from error
