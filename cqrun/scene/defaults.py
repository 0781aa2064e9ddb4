"""Defaults that depend on other parts of the scene: zero vectors, the only body."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Mapping
from typing import Annotated, Any

from cqrun.plugin.choice import Choice
from cqrun.plugin.contract import Spec
from cqrun.plugin.reference import FilledIn, field_types, is_union, marked_fields, marks
from cqrun.plugin.registry import plugins
from cqrun.scene.keypath import locate, replaced, value_at
from cqrun.scene.plugin_keys import PluginKeys
from cqrun.scene.sections import Sections


def with_defaults(scene: Any) -> Any:
    """Return plain scene data with defaults in its `FilledIn` fields; the schema reports unexpected data."""
    if not isinstance(scene, dict):
        return scene
    defaults = _defaults(scene)
    filled = _filled(Sections, scene, defaults)
    if scene.get("job") == "rest" and "time" not in scene:  # rest has none, but the same scene may move
        filled["time"] = {"duration": 1.0, "control_step": 1.0}
    given = scene.get("time", {})
    if scene.get("job") == "sysid" and isinstance(given, dict) and _all_at_rest(_mapping(scene.get("data"))):
        filled["time"] = {"duration": 0.01, "control_step": 0.01, **given}
    target = _mapping(_mapping(scene.get("data")).get("target"))
    if target and "only body" in defaults:  # is refused, and the advice names the body
        filled["data"] = {**filled["data"], "target": {"body": defaults["only body"], **target}}
    return filled


def with_vector(data: Any, path: str) -> Any:
    """Return data with a missing vector set to its default, if the path is an entry of one (`velocity.0`)."""
    parent, _, last = path.rpartition(".")
    if not last.isdigit():
        return data
    filled = with_defaults(data)
    loc = locate(filled, parent)
    vector = value_at(filled, loc)
    return replaced(data, loc, vector) if isinstance(vector, list) and value_at(data, loc) is None else data


def _all_at_rest(data: Mapping[str, Any]) -> bool:
    """Return whether all recordings are of bodies at rest, so that times have no meaning."""
    known = plugins("measurement")
    kinds = [
        [known[key] for key in recording if key in known]
        for recording in map(_mapping, _mapping(data.get("recordings")).values())
    ]
    return bool(kinds) and all(own and all(getattr(kind, "at_rest", False) is True for kind in own) for own in kinds)


def _defaults(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults for `FilledIn` fields, as far as the scene determines them."""
    size, bodies = _mapping(scene.get("world")).get("size"), _mapping(scene.get("bodies"))
    dim = len(size) if isinstance(size, list) and len(size) in (2, 3) else 3
    found: dict[str, Any] = {"zero vector": [0.0] * dim, "zero spin": [0.0] * (1 if dim == 2 else 3)}
    if len(bodies) == 1:
        found["only body"] = next(iter(bodies))
    return found


def _filled(cls: type[Spec], part: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return the plain data of a part of the scene, with the defaults of its fields and of the parts inside it."""
    filled = dict(part)
    for name, annotation in field_types(cls).items():
        if name in part:
            filled[name] = _inside(annotation, part[name], defaults)
    if issubclass(cls, PluginKeys):
        for name in part.keys() & plugins(cls.keys_of).keys():
            if isinstance(part[name], dict):
                filled[name] = _filled(plugins(cls.keys_of)[name], part[name], defaults)
    for name in marked_fields(cls, FilledIn):
        by = marks(cls.model_fields[name], FilledIn)[0].by
        if name not in part and by in defaults:
            filled[name] = defaults[by]
    return filled


def _inside(annotation: Any, value: Any, defaults: Mapping[str, Any]) -> Any:
    """Return a value of a type, with defaults in the parts inside it."""
    origin, args = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        choices = [mark for mark in args[1:] if isinstance(mark, Choice)]
        return _chosen(choices[0].kind, value, defaults) if choices else _inside(args[0], value, defaults)
    if is_union(annotation):
        for arg in args:
            value = _inside(arg, value, defaults)
    elif origin is list and isinstance(value, list):
        return [_inside(args[0], item, defaults) for item in value]
    elif origin is dict and isinstance(value, dict):
        return {key: _inside(args[1], item, defaults) for key, item in value.items()}
    elif inspect.isclass(annotation) and issubclass(annotation, Spec) and isinstance(value, dict):
        return _filled(annotation, value, defaults)
    return value


def _chosen(kind: str, value: Any, defaults: Mapping[str, Any]) -> Any:
    """Return a choice `name: {...}` of a plug-in, with defaults in it."""
    if not (isinstance(value, dict) and len(value) == 1):
        return value
    ((name, inside),) = value.items()
    cls = plugins(kind).get(name)
    if cls is None:
        return value
    if isinstance(inside, dict):
        return {name: _filled(cls, inside, defaults)}
    filled = _filled(cls, {cls.shorthand: inside}, defaults) if cls.shorthand else {}
    return {name: filled} if len(filled) > 1 else value


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
