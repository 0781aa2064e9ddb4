"""The learned values of a replay: single numbers go into the scene, all others stay in their file.

The file is that of a controller, with the other learned values, or the result of a run of sysid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from cqrun.build.particles import Particles
from cqrun.controllers.saved import read_controller
from cqrun.design.params import Params
from cqrun.errors import SceneError, UsageError
from cqrun.explain import listed
from cqrun.plugin.contract import Array
from cqrun.running.unknowns import values_found
from cqrun.scene.paths import canonical, leaf, shapes_a_body
from cqrun.scene.schema import Scene
from cqrun.scene.unknowns import tied
from cqrun.store.result import Value, read_result_file, values_in

IDENTIFIED = "identified.json"
"""File with the result of the run of sysid that a run replays."""

SUBSTEPS = "substeps"
"""Key of a controller's file: the number of substeps in a control step of its training."""

Learned = Mapping[str, Array]
"""Values by path: one number, or one per group or particle."""


def learned_in(controller: Path) -> dict[str, Array]:
    """Return the values that were learned with a controller; raise UsageError for another file."""
    _, meta = read_controller(controller)
    return {path: np.array(value, float) for path, value in meta.get("unknowns", {}).items()}


def substeps_in(controller: Path) -> int | None:
    """Return the number of substeps in a control step of a controller's training, or None in an older file."""
    _, meta = read_controller(controller)
    return meta.get(SUBSTEPS)


def identified_in(result: Path, scene: Scene) -> dict[str, Array]:
    """Return the values that a run of sysid has identified, and those of followers that are single numbers.

    Args:
        result: file of the run's result.
        scene: the run's scene, without overrides.
    """
    identified, values = _identified(result), dict[str, Array]()
    for path in scene.unknowns:
        name = canonical(scene, path)
        value = identified[name]
        of_path = {name: value} if isinstance(value, list) else tied(scene, path, value)
        values |= {other: np.array(number, float) for other, number in of_path.items()}
    return values


def as_overrides(file: Path, learned: Learned, scene: Scene) -> list[str]:
    """Return overrides that set a file's single numbers in a scene; raise UsageError if the scene lacks one of them."""
    for path in learned:
        try:
            leaf(scene, path)
        except SceneError:
            raise UsageError(f"{file}: {path} was learned in that run; this scene has no such number") from None
    return [f"{path}={value.item()!r}" for path, value in learned.items() if not is_kept_in_file(path, value)]


def refuse_learned(file: Path, learned: Learned, scene: Scene | None, overrides: Sequence[str]) -> None:
    """Raise UsageError for overrides of values that stay in a file, or of a section with such values.

    They would have no effect, because the values of the file are used.

    Args:
        file: the file with the values.
        scene: the scene without the overrides, for the long form of its paths; None if it is not valid.
        overrides: list of `key.path=value`.
    """
    kept = {path: value for path, value in learned.items() if is_kept_in_file(path, value)}
    for override in overrides:
        key = _spelt_out(scene, override.partition("=")[0].strip())
        if key in kept and kept[key].ndim:
            raise UsageError(f"-o {override}: {file} has a value of it for every group or particle, which were learned")
        if key in kept:
            raise UsageError(f"-o {override}: {file} holds the body's geometry, which was learned")
        if inside := [path for path in kept if path.startswith(f"{key}.")]:
            raise UsageError(
                f"-o {override}: {file} holds {listed(inside)}, which was learned; override other values only"
            )


def design_in(file: Path, scene: Scene, overrides: Sequence[str]) -> dict[str, Array]:
    """Return the values by path that were learned with a controller, without those that overrides replace.

    Arguments and errors are those of `refuse_learned`.
    """
    learned = learned_in(file)
    refuse_learned(file, learned, scene, overrides)
    keys = [_spelt_out(scene, override.partition("=")[0].strip()) for override in overrides]
    return {path: value for path, value in learned.items() if not any(f"{path}.".startswith(f"{key}.") for key in keys)}


def _spelt_out(scene: Scene | None, key: str) -> str:
    """Return the long form of a key path, or the path itself if the scene does not have it."""
    try:
        return key if scene is None else canonical(scene, key)
    except SceneError:
        return key


def is_kept_in_file(path: str, value: Array) -> bool:
    """Return whether a learned value stays in its file and does not go into the scene.

    Such values are per group or particle, or they shape a body: sampling the new shape would give other particles.
    """
    return value.ndim > 0 or shapes_a_body(path)


def kept_values(controller: Path) -> dict[str, Array]:
    """Return the values of a replay by path that are not in its scene; raise UsageError for another file."""
    return {path: value for path, value in learned_in(controller).items() if is_kept_in_file(path, value)}


def kept_of_identified(result: Path, scene: Scene, particles: Particles) -> dict[str, Array]:
    """Return the same values for a run of sysid, from its result."""
    values = values_found(scene, particles, _identified(result))
    return {path: value for path, value in values.items() if is_kept_in_file(path, value)}


def require_fitting(file: Path, kept: Learned, params: Params) -> None:
    """Raise UsageError if values do not have the shapes of the scene's unknowns."""
    sizes = {block.path: block.initial.shape for block in params.blocks}
    sizes |= {f.path: block.initial.shape for block in params.blocks for f in block.followers}
    for name, array in kept.items():
        if array.shape != sizes.get(name):
            raise UsageError(
                f"{file}: holds {array.size} numbers of {name} that were learned; this scene's unknowns have "
                f"{sizes.get(name, 'none')}: bodies and particles must be those it was trained with"
            )


def _identified(result: Path) -> dict[str, Value]:
    """Return the values of the unknowns in a result file by path."""
    return values_in(read_result_file(result))
