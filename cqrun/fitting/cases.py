"""Make the cases of a fit: one per recording or sequence of activations, or a single one for an objective."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from cqrun.build.model import Built
from cqrun.errors import Problem, RolloutError, RunError, SceneError
from cqrun.fitting.at_rest import questions
from cqrun.fitting.case import Case
from cqrun.fitting.recorded import recorded_cases
from cqrun.fitting.synthetic import synthetic_cases
from cqrun.fitting.wanted import wanted_case
from cqrun.running.runs import data_files
from cqrun.running.unknowns import make_params
from cqrun.scene.schema import Scene
from cqrun.store.run import RunDirectory


def is_fit(scene: Scene) -> bool:
    """Return whether a scene has unknowns, data or an objective to fit them to, and no controller."""
    if not scene.unknowns or scene.controller is not None or scene.predicts_only:
        return False
    return scene.data is not None or bool(scene.objective)


def make_cases(built: Built, directory: Path | None = None, interrupt: Callable[[], None] = lambda: None) -> list[Case]:
    """Return the cases of a scene's data or, without data, of its objective.

    Args:
        built: the scene.
        directory: folder for synthetic data; without it the data stay in memory.
        interrupt: called before every rollout that makes data.

    Raises:
        SceneError: the data or the objective cannot be used.
    """
    data = built.scene.data
    if data is None and built.scene.objective:
        return [wanted_case(built)]
    if data is None:
        where = built.scene.where("")
        raise SceneError([Problem(where, "data", "is missing: add `recordings` or `synthetic`")])
    if data.recordings is not None:
        return recorded_cases(built, data.recordings)
    assert data.synthetic is not None
    return synthetic_cases(built, data.synthetic, directory, interrupt)


def given_cases(built: Built) -> list[Case] | None:
    """Return the cases of recordings or an objective; None if there are none, or if the run makes its own data.

    They are read before the run directory is made, so that unusable data leave no directory behind.

    Raises:
        SceneError: data are missing or cannot be used.
    """
    scene = built.scene
    if scene.synthetic is not None or (scene.data is None and not is_fit(scene)):
        return None
    data_files(scene)  # reports all missing files at once
    return make_cases(built)


def recording_warnings(built: Built, cases: Sequence[Case]) -> Iterator[str]:
    """Yield what looks wrong in recordings, and the warnings of their scenes that the scene itself does not have."""
    known = {warning.message for warning in built.warnings}
    starts = make_params(built).start_values if any(case.points for case in cases) else {}
    for case in cases:
        yield from (f"{case.name}: {warning}" for warning in case.built.warnings if warning.message not in known)
        yield from (f"{case.name}: {doubt}" for comparison in case.comparisons for doubt in comparison.doubts)
        yield from (f"{case.name}: {question}" for question in questions(case, starts))


def remarks(cases: Sequence[Case]) -> Iterator[str]:
    """Yield a sentence about how each recording was read."""
    for case in cases:
        yield from (f"{case.name}: {comparison.remark}" for comparison in case.comparisons if comparison.remark)


def made_cases(run: RunDirectory, built: Built, interrupt: Callable[[], None]) -> list[Case]:
    """Return the cases of the data that a run makes with the true values.

    Args:
        interrupt: called before every rollout.

    Raises:
        RunError: the rollout with the true values fails. And what `interrupt` raises.
    """
    try:
        return make_cases(built, run.path, interrupt)
    except RolloutError as error:
        run.finish("failed", f"data.synthetic.truth: {error}")
        raise RunError(f"{run.path}: data.synthetic.truth: {error}") from error
