"""What a run has learned or identified, and acts in a replay: single numbers in the scene, all others from a file.

A run of control or co-design keeps them in its controller's file, one of sysid in its result.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cqrun.contract import Array
from cqrun.controllers.saved import read_controller
from cqrun.design.params import Params
from cqrun.errors import SceneError, UsageError
from cqrun.jobs.unknowns import values_found
from cqrun.scene.particles import Particles
from cqrun.scene.paths import canonical, leaf, shapes_a_body
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import tied

IDENTIFIED = "identified.json"
"""Where a replay of a run of sysid keeps that run's result."""


def learned_values(file: Path, scene: Scene, overrides: Sequence[str]) -> list[str]:
    """Return overrides that give a scene the single numbers that were learned with a controller.

    Raises:
        UsageError: the file is no controller's, the scene has no such number, or an override is of numbers that were
            learned for each group or particle.
    """
    _, meta = read_controller(file)
    return _as_overrides(file, meta.get("unknowns", {}), scene, overrides)


def identified_values(file: Path, own: Scene, scene: Scene, overrides: Sequence[str]) -> list[str]:
    """Return overrides that give a scene the single numbers that a run has identified, and what follows them.

    Args:
        file: the run's result.
        own: the run's scene, without overrides.
        scene: the same with them.
        overrides: of the user.

    Raises:
        UsageError: as `learned_values`.
    """
    found = _unknowns(file)
    values: dict[str, Any] = {}
    for path in own.unknowns:
        name = canonical(own, path)
        value = found[name]["value"]
        values |= {name: value} if isinstance(value, list) else tied(own, path, value)
    return _as_overrides(file, values, scene, overrides)


def _as_overrides(file: Path, learned: Mapping[str, Any], scene: Scene, overrides: Sequence[str]) -> list[str]:
    for path in learned:
        try:
            leaf(scene, path)
        except SceneError:
            raise UsageError(f"{file}: {path} was learned in that run; this scene has no such number") from None
    kept = {path for path, value in learned.items() if is_kept_in_file(path, np.array(value))}
    for override in overrides:
        key = override.partition("=")[0].strip()
        if isinstance(learned.get(key), list):
            raise UsageError(f"-o {override}: {file} has a value of it for every group or particle, which were learned")
        if key in kept:
            raise UsageError(f"-o {override}: {file} holds the body's geometry, which was learned")
    return [f"{path}={value!r}" for path, value in learned.items() if path not in kept]


def is_kept_in_file(path: str, value: Array) -> bool:
    """Say whether a learned value stays in the file that has it, and does not go into the scene.

    It is one a group or particle, or it shapes a body: particles follow it, sampled anew they would be others.
    """
    return value.ndim > 0 or shapes_a_body(path)


def kept_values(file: Path) -> dict[str, Array]:
    """Return the values by path that act in a replay and that its scene does not have; UsageError for another file."""
    _, meta = read_controller(file)
    learned = {path: np.array(value, float) for path, value in meta.get("unknowns", {}).items()}
    return {path: value for path, value in learned.items() if is_kept_in_file(path, value)}


def kept_of_identified(file: Path, scene: Scene, particles: Particles) -> dict[str, Array]:
    """Return the same values of a run of sysid, from its result."""
    values = values_found(scene, particles, _unknowns(file))
    return {path: value for path, value in values.items() if is_kept_in_file(path, value)}


def require_fitting(file: Path, kept: Mapping[str, Array], params: Params) -> None:
    """Refuse values for groups or particles that the unknowns of a scene do not have.

    Raises:
        UsageError: with both numbers.
    """
    sizes = {block.path: block.initial.shape for block in params.blocks}
    sizes |= {f.path: block.initial.shape for block in params.blocks for f in block.followers}
    for name, array in kept.items():
        if array.shape != sizes.get(name):
            raise UsageError(
                f"{file}: holds {array.size} numbers of {name} that were learned; this scene's unknowns have "
                f"{sizes.get(name, 'none')}: bodies and particles must be those it was trained with"
            )


def _unknowns(file: Path) -> dict[str, Any]:
    """Return the unknowns of a run's result: path -> its entry."""
    try:
        found: dict[str, Any] = json.loads(file.read_text())["unknowns"]
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"{file}: unreadable ({error}); run the scene again with --fresh") from error
    return found
