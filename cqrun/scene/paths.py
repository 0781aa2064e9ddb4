"""Key paths of a scene: read, replace and describe the value at a path.

Overrides (`-o`), unknowns, error messages and results use the same paths.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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
from cqrun.scene.keypath import first_key, joined, locate, replaced
from cqrun.scene.material import TERMS, Terms
from cqrun.scene.schema import Scene
from cqrun.scene.walk import children


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
    return LeafInfo(joined(loc), value, unit, _reached(owner, name, loc), low, high)


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


def _reached(owner: type[BaseModel], name: str, loc: Sequence[int | str]) -> bool:
    """Return whether gradients reach a field at a place."""
    if name not in owner.model_fields:
        return False
    return is_differentiable(owner, name) or (is_geometric(owner, name) and shapes_a_body(joined(loc)))


def leaves(scene: Scene, *, differentiable: bool = False) -> Iterator[str]:
    """Yield the path of every number in a scene, or only of those that gradients reach."""
    yield from _leaves(scene, (), False, not differentiable)


def with_values(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """Return a new scene with values replaced by path, validated as a whole.

    Args:
        scene: any scene.
        values: key path -> number, text, list or mapping, in plain Python or NumPy.

    Raises:
        SceneError: a path does not exist, or its field refuses the value.
    """
    data: Any = scene.model_dump(exclude_none=True)
    problems = []
    for path, value in values.items():
        try:
            data = replaced(data, locate(data, path), plain(value))
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
            raise SceneError([Problem(scene.where(path), path, _missing(scene, path, loc, rest, node))])
        if isinstance(node, Spec):
            owner, name = type(node), str(key)
        node = inside[key]
        loc.append(key)
        rest = rest[len(str(key)) + 1 :]
    if not loc:
        raise SceneError([Problem(scene.where(""), "", "is an empty path")])
    return tuple(loc), owner, name, node


def _missing(scene: Scene, path: str, loc: list[int | str], rest: str, node: Any) -> str:
    place = f"'{joined(loc)}'" if loc else "the scene"
    key, inside = rest.partition(".")[0], children(node)
    if isinstance(node, Terms) and key in plugins(TERMS):
        return f"{place} has no '{key}': write the term there first, with a value to start from"
    if node is None and loc:
        return f"{place} is not set in this scene: write it there first, with a value of '{rest}' to start from"
    sibling = suggest(key, map(str, inside))
    known = (leaf for leaf in leaves(scene) if not leaf.startswith(("unknowns.", "data.synthetic.truth.")))
    near = sibling if key == rest else suggest(path, known) or sibling
    existing = f"; there are: {listed(map(str, inside))}" if inside else ""
    return f"{place} has no '{key}'{near}{existing}"


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
            reached = _reached(type(node), str(key), (*loc, key))
        yield from _leaves(child, (*loc, key), reached, all_leaves)
