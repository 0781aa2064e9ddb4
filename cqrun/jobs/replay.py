"""What was learned beside a controller and acts in a replay: single numbers in the scene, all others from its file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cqrun.contract import Array
from cqrun.controllers.saved import read_controller
from cqrun.errors import SceneError, UsageError
from cqrun.scene.paths import leaf, shapes_a_body
from cqrun.scene.schema import Scene


def learned_values(file: Path, scene: Scene, overrides: Sequence[str]) -> list[str]:
    """Return overrides that give a scene the single numbers that were learned with a controller.

    Raises:
        UsageError: the file is no controller's, the scene has no such number, or an override is of numbers that were
            learned for each group or particle.
    """
    _, meta = read_controller(file)
    learned = meta.get("unknowns", {})
    for path in learned:
        try:
            leaf(scene, path)
        except SceneError:
            raise UsageError(f"{file}: {path} was learned with the controller; this scene has no such number") from None
    kept = {path for path, value in learned.items() if is_kept_by_controller(path, np.array(value))}
    for override in overrides:
        key = override.partition("=")[0].strip()
        if isinstance(learned.get(key), list):
            raise UsageError(f"-o {override}: {file} has a value of it for every group or particle, which were learned")
        if key in kept:
            raise UsageError(f"-o {override}: {file} holds the body's geometry, which was learned")
    return [f"{path}={value!r}" for path, value in learned.items() if path not in kept]


def is_kept_by_controller(path: str, value: Array) -> bool:
    """Say whether a learned value goes with the controller's file, and not into the scene.

    It is one a group or particle, or it shapes a body: particles follow it, sampled anew they would be others.
    """
    return value.ndim > 0 or shapes_a_body(path)


def kept_values(file: Path) -> dict[str, Array]:
    """Return the values by path that act in a replay and that its scene does not have; UsageError for another file."""
    _, meta = read_controller(file)
    learned = {path: np.array(value, float) for path, value in meta.get("unknowns", {}).items()}
    return {path: value for path, value in learned.items() if is_kept_by_controller(path, value)}
