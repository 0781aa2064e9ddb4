"""What was learned beside a controller and acts in a replay: single numbers in the scene, all others from its file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cqrun.contract import Array
from cqrun.controllers.saved import read_controller
from cqrun.errors import SceneError, UsageError
from cqrun.explain import listed
from cqrun.scene.paths import canonical, leaf, shapes_a_body
from cqrun.scene.schema import Scene


def learned_values(file: Path, scene: Scene) -> list[str]:
    """Return overrides that give a scene the single numbers that were learned with a controller.

    Raises:
        UsageError: the file is no controller's, or the scene has no such number.
    """
    learned = _learned(file)
    for path in learned:
        try:
            leaf(scene, path)
        except SceneError:
            raise UsageError(f"{file}: {path} was learned with the controller; this scene has no such number") from None
    return [f"{path}={value.item()!r}" for path, value in learned.items() if not is_kept_by_controller(path, value)]


def refuse_learned(file: Path, scene: Scene | None, overrides: Sequence[str]) -> None:
    """Refuse overrides of what a controller's file keeps, or of a part that holds it: the file's would act.

    Args:
        file: the controller's.
        scene: as it is without the overrides, which knows how its paths are spelt at length; None where it cannot be.
        overrides: `key.path=value` each.

    Raises:
        UsageError: there is one, or the file is no controller's.
    """
    kept = kept_values(file)
    for override in overrides:
        key = _spelt_out(scene, override.partition("=")[0].strip())
        if key in kept and kept[key].ndim:
            raise UsageError(f"-o {override}: {file} has a value of it for every group or particle, which were learned")
        if key in kept:
            raise UsageError(f"-o {override}: {file} holds the body's geometry, which was learned")
        if inside := [path for path in kept if path.startswith(f"{key}.")]:
            raise UsageError(
                f"-o {override}: {file} holds {listed(inside)}, which was learned; override what is beside it"
            )


def design_in(file: Path, scene: Scene, overrides: Sequence[str]) -> dict[str, Array]:
    """Return the values by path that were learned with a controller, without those that overrides replace.

    Arguments and errors as `refuse_learned`.
    """
    refuse_learned(file, scene, overrides)
    keys = [_spelt_out(scene, override.partition("=")[0].strip()) for override in overrides]
    own = _learned(file)
    return {path: value for path, value in own.items() if not any(f"{path}.".startswith(f"{key}.") for key in keys)}


def _spelt_out(scene: Scene | None, key: str) -> str:
    """Return the long spelling of a key path, or the path itself where a scene has nothing there."""
    try:
        return key if scene is None else canonical(scene, key)
    except SceneError:
        return key


def is_kept_by_controller(path: str, value: Array) -> bool:
    """Say whether a learned value goes with the controller's file, and not into the scene.

    It is one a group or particle, or it shapes a body: particles follow it, sampled anew they would be others.
    """
    return value.ndim > 0 or shapes_a_body(path)


def kept_values(file: Path) -> dict[str, Array]:
    """Return the values by path that act in a replay and that its scene does not have; UsageError for another file."""
    return {path: value for path, value in _learned(file).items() if is_kept_by_controller(path, value)}


def _learned(file: Path) -> dict[str, Array]:
    """Return the values by path that were learned with a controller; UsageError for another file."""
    _, meta = read_controller(file)
    return {path: np.array(value, float) for path, value in meta.get("unknowns", {}).items()}
