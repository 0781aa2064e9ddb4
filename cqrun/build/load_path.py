"""The points of a scene's `path` as values by key path, and as inputs of the engine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cqrun.build.model import Built
from cqrun.engine.model import Inputs
from cqrun.errors import Problem, SceneError
from cqrun.explain import listed
from cqrun.plugin.contract import Array
from cqrun.scene.load_path import ACTIVATION, values_of
from cqrun.scene.paths import canonical, leaf, shapes_a_body, with_values
from cqrun.scene.schema import Scene


def points_of(built: Built) -> list[dict[str, float]]:
    """Return the values of every point by key path; a scene without `path` has one point without values.

    Raises:
        SceneError: a key does not exist or cannot change in rest, or the lists have different lengths.
    """
    scene, columns = built.scene, {}
    for key, entry in scene.path.items():
        columns[checked_key(built, key, f"path.{key}", values_of(entry))] = values_of(entry)
    lengths = {key: len(values) for key, values in columns.items()}
    if len(set(lengths.values())) > 1:
        each = ", ".join(f"{key} has {count}" for key, count in lengths.items())
        raise _problem(scene, "path", f"all keys need the same number of values: {each}")
    count = next(iter(lengths.values()), 1)
    return [{key: values[k] for key, values in columns.items()} for k in range(count)]


def inputs_of(built: Built, point: Mapping[str, float], values: Mapping[str, Array] | None = None) -> Inputs:
    """Return the engine's inputs at a point; `values` by path, such as those of a fit, hold elsewhere."""
    numbers = {key: np.array(value) for key, value in point.items() if not key.startswith(ACTIVATION)}
    inputs = built.assembly.inputs({**(values or {}), **numbers})
    activation = inputs.activation[-1:].copy()
    for key, value in point.items():
        if key.startswith(ACTIVATION):
            activation[0, _parts(built, key, f"path.{key}")] = value
    return replace(inputs, activation=activation)


def idle_actuators(built: Built) -> dict[str, str]:
    """Return what is wrong with each actuator that nothing activates at rest, by the key path of its strength.

    A spring, or a cable with a stiffness, whose neutral activation is 1, pulls without a motor once it is stretched.
    """
    actuation, found = built.assembly.actuation, {}
    last = actuation.activations(built.assembly.sequence, {})[-1]
    for part, activation, neutral in zip(actuation.parts, last, actuation.neutral, strict=True):
        if activation == neutral == 0.0:
            path = f"{part.path}.{part.spec.scale}"
            found[path] = (
                f"'{path}' does nothing, because the activation of '{part.name}' is {activation:g} at rest: give "
                f"`activation: {{signals: {{{part.actuator}: [1]}}}}`"
            )
    return found


def gradient_of(built: Built, point: Mapping[str, float], values: Mapping[str, Array], bar: Inputs) -> dict[str, Array]:
    """Return the gradient by every path of `values` from the cotangent of `inputs_of`; zero where the point sets it."""
    activation_bar = np.zeros((built.model.n_controls, len(built.assembly.actuation.parts)))
    activation_bar[-1] = bar.activation[-1]
    for key in point:
        if key.startswith(ACTIVATION):
            activation_bar[-1, _parts(built, key, "")] = 0.0
    numbers = {key: np.array(value) for key, value in point.items() if not key.startswith(ACTIVATION)}
    gradient = built.assembly.gradient({**values, **numbers}, replace(bar, activation=activation_bar))
    return {path: np.zeros(np.shape(value)) if path in numbers else gradient[path] for path, value in values.items()}


def checked_key(built: Built, key: str, where: str, values: Sequence[float]) -> str:
    """Return the long form of a key path, or of an activation, that can have these values along a path of equilibria.

    Args:
        where: the place in the scene that names the key, for errors.

    Raises:
        SceneError: it does not exist, cannot change in rest, or does not allow a value.
    """
    scene = built.scene
    if key.startswith(ACTIVATION):
        _check_activation(built, key, where, values)
        return key
    try:
        info, long = leaf(scene, key), canonical(scene, key)
    except SceneError as error:
        message = str(error.problems[0].message)
        raise _problem(scene, where, message if where.endswith(key) else f"{key}: {message}") from None
    if shapes_a_body(long):
        raise _problem(scene, where, "changes the rest shape of a body: a path changes loads, forces and activations")
    if not info.differentiable:
        raise _problem(scene, where, "cannot change along a path: no force depends on it continuously")
    for value in {min(values), max(values)}:
        try:
            with_values(scene, {long: value})
        except SceneError as error:
            raise _problem(scene, where, f"{long}: {error.problems[0].message}") from None
    return long


def _check_activation(built: Built, key: str, where: str, values: Sequence[float]) -> None:
    actuation = built.assembly.actuation
    for k in _parts(built, key, where):
        low, high = actuation.low[k], actuation.high[k]
        wrong = [value for value in values if not low <= value <= high]
        if wrong:
            message = f"{wrong[0]:g} is outside the actuator's limits, {low:g} to {high:g}"
            raise _problem(built.scene, where, message)


def _parts(built: Built, key: str, where: str) -> list[int]:
    """Return the numbers of the parts that a key of an activation names: a part, or all parts of an actuator."""
    name, parts = key.removeprefix(ACTIVATION), built.assembly.actuation.parts
    found = [k for k, part in enumerate(parts) if name in (part.name, part.actuator)]
    if not found:
        names = dict.fromkeys([*(part.actuator for part in parts), *(part.name for part in parts)])
        known = f"the scene has {listed(names)}" if names else "the scene has no actuators"
        raise _problem(built.scene, where, f"there is no actuator '{name}'; {known}")
    return found


def _problem(scene: Scene, path: str, message: str) -> SceneError:
    return SceneError([Problem(scene.where(path), path, message)])
