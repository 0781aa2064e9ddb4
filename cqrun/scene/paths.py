"""Key paths of a scene: read, replace and describe the value at a path.

Overrides (`-o`), unknowns, error messages and results use the same paths. `data.recordings.NAME.overrides.PATH` is the
value at PATH in the scene of one recording, whether its `overrides` name PATH or not.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import annotated_types
import numpy as np
from pydantic import BaseModel, ValidationError

from cqrun.errors import Problem, SceneError
from cqrun.explain import Loc, listed, suggest
from cqrun.plugin.choice import Chosen
from cqrun.plugin.contract import Plugin, Spec, field_unit, is_differentiable, is_geometric
from cqrun.plugin.registry import plugins
from cqrun.scene.data import Recording
from cqrun.scene.defaults import with_vector
from cqrun.scene.keypath import first_key, joined, locate, own_path, replaced, split_own, value_at
from cqrun.scene.material import TERMS, Terms
from cqrun.scene.schema import Scene
from cqrun.scene.walk import children

FIXED = ("data", "unknowns", "optimizer", "time", "job", "title", "seed", "memory", "precision", "cqrun")
"""Sections that all recordings of a scene share, so that no recording can have values of its own there."""


@dataclass(frozen=True)
class LeafInfo:
    """A number in a scene, with its unit and range.

    `minimum` and `maximum` are the ends of the field's range, or None. Only validation checks whether an end itself is
    legal: `poissons_ratio` must be less than 0.5.
    """

    path: str
    value: float | int
    unit: str
    differentiable: bool
    minimum: float | None
    maximum: float | None


def get(scene: Scene, path: str) -> Any:
    """Return the value at a path: a number, text, list, mapping or part; raise a SceneError if there is nothing."""
    return _find(scene, path)[-1]


def canonical(scene: Scene, path: str) -> str:
    """Return the long form of a path (`union.0` is `union.shapes.0`); raise a SceneError if there is nothing."""
    return joined(_find(scene, path)[0])


def leaf(scene: Scene, path: str) -> LeafInfo:
    """Describe the number at a path; raise a SceneError if there is none."""
    loc, owner, name, value = _find(scene, path)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise SceneError([Problem(scene.where(path), path, _not_a_number(path, value))])
    low, high = _range(owner, name)
    unit = field_unit(owner, name) or "1"
    recording, inside = split_own(joined(loc))
    fixed = bool(recording) and inside.partition(".")[0] in FIXED
    return LeafInfo(joined(loc), value, unit, not fixed and _reached(owner, name, inside), low, high)


def shapes_a_body(path: str) -> bool:
    """Return whether a path, in its long form, belongs to the shape or place of a body, so that particles follow it.

    Particles follow the first shape of a difference or intersection. Its holes move and stretch with it, and the
    numbers of the other shapes, which cut it, move nothing.
    """
    keys = path.split(".")
    if len(keys) < 4 or keys[0] != "bodies" or keys[2] not in ("shape", "parts", "place"):
        return False
    return all(index == "0" for _, index in cuts(path))


def cuts(path: str) -> list[tuple[str, str]]:
    """Return (name, index) of the differences and intersections that a path, in its long form, goes through."""
    keys = path.split(".")
    pairs = zip(keys, keys[1:], keys[2:], strict=False)
    return [(name, index) for name, of, index in pairs if name in ("difference", "intersection") and of == "shapes"]


def _reached(owner: type[BaseModel], name: str, path: str) -> bool:
    """Return whether gradients reach a field at a path."""
    if name not in owner.model_fields:
        return False
    return is_differentiable(owner, name) or (is_geometric(owner, name) and shapes_a_body(path))


def leaves(scene: Scene, *, differentiable: bool = False) -> Iterator[str]:
    """Yield the path of every number in a scene, or only of those that gradients reach."""
    yield from _leaves(scene, (), False, not differentiable)


def with_values(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """Return a new scene with values replaced by path, validated as a whole.

    Args:
        scene: any scene.
        values: key path -> number, text, list or mapping, in plain Python or NumPy.

    Raises:
        SceneError: a path does not exist, or its field refuses the value. What a recording overrides is checked only in
            its own scene (`as_recorded`).
    """
    data: Any = scene.model_dump(exclude_none=True)
    problems = []
    for path, value in values.items():
        try:
            data = with_vector(data, path)
            data = replaced(data, _place(data, path), plain(value))
        except KeyError as error:
            problems.append(Problem(scene.where(path), path, str(error.args[0])))
    if problems:
        raise SceneError(problems)
    try:
        changed = Scene.model_validate(data)
    except ValidationError as error:
        raise SceneError(scene._origin.problems(error)) from None
    changed.set_origin(scene._origin)
    return changed


def _place(data: Any, path: str) -> Loc:
    """Return where the value at a path goes in plain data."""
    loc, (recording, inside) = locate(data, path), split_own(path)
    if recording and value_at(data, loc) is None:  # no override has it yet, or one that contains it has its default
        return *loc[:4], inside
    return loc


def as_recorded(scene: Scene, recording: str) -> Scene:
    """Return a scene with the overrides of a recording; raise a SceneError if the scene refuses one of them."""
    return with_values(scene, scene.recordings[recording].overrides)


def require_possible(scene: Scene, values: Mapping[str, Any]) -> None:
    """Raise a SceneError if the scene, or that of a recording with a value of its own, refuses values by path."""
    changed = with_values(scene, values)
    for recording in dict.fromkeys(split_own(path)[0] for path in values):
        if recording in changed.recordings:
            with _problems_of(scene, recording):
                as_recorded(changed, recording)


def plain(value: Any) -> Any:
    """Return a value with NumPy numbers and arrays converted to Python's numbers and lists."""
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return value


def _find(scene: Scene, path: str) -> tuple[Loc, type[BaseModel], str, Any]:
    """Return the place of a path, the model and field that contain it, and its value."""
    recording, inside = split_own(path)
    if recording not in scene.recordings:
        return _walk(scene, path)
    with _problems_of(scene, recording):
        loc, owner, name, value = _walk(as_recorded(scene, recording), inside, own_path(recording, ""))
    return ("data", "recordings", recording, "overrides", *loc), owner, name, value


@contextmanager
def _problems_of(scene: Scene, recording: str) -> Iterator[None]:
    """Give the problems of the scene of a recording the paths that they have in the scene itself."""
    try:
        yield
    except SceneError as error:
        paths = [own_path(recording, problem.path) for problem in error.problems]
        raise SceneError(
            [Problem(scene.where(p), p, problem.message) for p, problem in zip(paths, error.problems, strict=True)]
        ) from None


def _walk(scene: Scene, path: str, prefix: str = "") -> tuple[Loc, type[BaseModel], str, Any]:
    """Return what `_find` does; `prefix` is what a user writes before a path of this scene."""
    loc: list[int | str] = []
    node: Any = scene
    owner: type[Spec] = type(scene)
    name, rest = "", path
    while rest:
        inside = children(node)
        key = first_key(inside, rest)
        if key is None and isinstance(node, Plugin) and node.shorthand and rest.partition(".")[0].isdigit():
            key, rest = node.shorthand, f"{node.shorthand}.{rest}"
        if key is None:
            raise SceneError([Problem(scene.where(path), path, _missing(scene, path, loc, rest, node, prefix))])
        if isinstance(node, Spec):
            owner, name = type(node), str(key)
        node = inside[key]
        loc.append(key)
        rest = rest[len(str(key)) + 1 :]
    if not loc:
        raise SceneError([Problem(scene.where(""), "", "is an empty path")])
    return tuple(loc), owner, name, node


def _missing(scene: Scene, path: str, loc: list[int | str], rest: str, node: Any, prefix: str) -> str:
    place = f"'{joined(loc)}'" if loc else "the scene"
    key, inside = rest.partition(".")[0], children(node)
    if isinstance(node, Terms) and key in plugins(TERMS):
        return f"{place} has no '{key}': write the term there first, with a value to start from"
    if node is None and loc:
        return f"{place} is not set in this scene: write it there first, with a value of '{rest}' to start from"
    if isinstance(node, Recording) and (own := _own(scene, str(loc[-1]), rest)):
        return f"{place} has no '{key}': the value that this recording alone has there is '{own}'"
    sibling = suggest(key, map(str, inside))
    if split_own(path)[0]:  # of a recording that does not exist
        return f"{place} has no '{key}'{sibling}; there are: {listed(map(str, inside))}"
    skipped = ("unknowns.", "data.") if prefix else ("unknowns.", "data.synthetic.truth.")
    known = (f"{prefix}{leaf}" for leaf in leaves(scene) if not leaf.startswith(skipped))
    near = sibling if key == rest else suggest(f"{prefix}{path}", known) or sibling
    existing = f"; there are: {listed(map(str, inside))}" if inside else ""
    if isinstance(node, Recording):
        own = own_path(str(loc[-1]), "PATH")
        existing += f"; any other value of this recording alone is {own}, such as world.gravity.0 for its tilt"
    return f"{place} has no '{key}'{near}{existing}"


def _own(scene: Scene, recording: str, path: str) -> str:
    """Return the key path of a recording's own value that a path without `overrides` means; empty if it means none."""
    meant = (name for name in leaves(scene, differentiable=True) if f".{name}".endswith(f".{path}"))
    own = next((name for name in meant if name.partition(".")[0] not in FIXED), path)
    try:
        return own_path(recording, own) if leaf(scene, own_path(recording, own)).differentiable else ""
    except SceneError:
        return ""


def _not_a_number(path: str, value: Any) -> str:
    if value is None:
        return "is not set in this scene: give it a value"
    if isinstance(value, (list, dict, Chosen, Spec)):
        inside = [f"{path}.{key}" for key in children(value)]
        return f"is not a number but contains others: name one of {listed(inside, 4)}"
    return f"must be a number, is {value!r}"


def _range(owner: type[BaseModel], name: str) -> tuple[float | None, float | None]:
    low = high = None
    for item in owner.model_fields[name].metadata if name in owner.model_fields else ():
        match item:
            case annotated_types.Gt(gt=value) | annotated_types.Ge(ge=value):
                low = value
            case annotated_types.Lt(lt=value) | annotated_types.Le(le=value):
                high = value
    return low, high  # type: ignore[return-value]  # annotated_types knows only that they compare


def _leaves(node: Any, loc: Loc, reached: bool, all_leaves: bool) -> Iterator[str]:
    if isinstance(node, (int, float)) and not isinstance(node, bool):
        if reached or all_leaves:
            yield joined(loc)
        return
    for key, child in children(node).items():
        if isinstance(node, Spec):
            reached = _reached(type(node), str(key), joined((*loc, key)))
        yield from _leaves(child, (*loc, key), reached, all_leaves)
