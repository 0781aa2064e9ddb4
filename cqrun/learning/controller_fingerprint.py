"""A controller's fingerprint: the settings that decide how its parameters act.

Ranges of observations are not part of it, because a replay uses those of the training; nor are a controller's start
values.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from cqrun.build.model import Built
from cqrun.explain import Loc
from cqrun.scene.keypath import joined
from cqrun.scene.load import resolve

RANGE = "range"
"""The field of an observer whose numbers are in the controller's file."""


def controller_fingerprint(built: Built, learned: Collection[str]) -> dict[str, Any]:
    """Return the settings of a scene's controller, its observers and its actuators' limits, by key path.

    Args:
        built: a scene with a controller.
        learned: names of the controller's parameters; a field with such a name has its start value.
    """
    chosen: Any = built.scene.controller
    data, start = resolve(built.scene), {*chosen.value.initial_fields, *learned}
    controller = {chosen.name: {key: v for key, v in data["controller"][chosen.name].items() if key not in start}}
    settings = dict(_leaves(("controller",), controller)) | dict(_leaves(("observers",), data.get("observers", {})))
    for part in built.assembly.actuation.parts:
        settings[f"actuators.{part.actuator} (limits)"] = list(part.spec.limits)
        settings[f"{part.path}.rate"] = part.spec.rate
    return {path: value for path, value in settings.items() if value is not None}


def _leaves(loc: Loc, data: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield key paths and values of plain data; a list is one value."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from _leaves((*loc, key), value)
        elif RANGE not in (key, loc[-1]):
            yield joined((*loc, key)), value


def differences(file: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return a sentence on the settings that have changed since the training; an empty list if none has."""
    changed = [path for path in {**then, **now} if then.get(path) != now.get(path)]
    changes = (f"{path} was {then.get(path, 'absent')}, is {now.get(path, 'absent')}" for path in changed)
    return [f"{file}: acts differently than in its training: {'; '.join(changes)}"] if changed else []
