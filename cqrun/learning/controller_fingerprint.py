"""What the parameters in a controller's file mean: the same numbers act otherwise in another controller, or of what is
seen otherwise.

Ranges of observations are no part of it, since a replay has those of the training; nor is what says where a controller
starts.
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
"""The field of an observer that the file has the numbers of."""


def meaning_of(built: Built, learned: Collection[str]) -> dict[str, Any]:
    """Return what a scene says of its controller, its observers and its actuators' limits, by key path.

    Args:
        built: a scene with a controller.
        learned: names of the controller's parameters: a field of such a name is where that one starts.
    """
    chosen: Any = built.scene.controller
    data, start = resolve(built.scene), {*chosen.value.initial_fields, *learned}
    controller = {chosen.name: {key: v for key, v in data["controller"][chosen.name].items() if key not in start}}
    said = dict(_leaves(("controller",), controller)) | dict(_leaves(("observers",), data.get("observers", {})))
    for part in built.assembly.actuation.parts:
        said[f"actuators.{part.actuator} (limits)"] = list(part.spec.limits)
        said[f"{part.path}.rate"] = part.spec.rate
    return {path: value for path, value in said.items() if value is not None}


def _leaves(loc: Loc, data: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield key paths and values of plain data, lists as a whole."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from _leaves((*loc, key), value)
        elif RANGE not in (key, loc[-1]):
            yield joined((*loc, key)), value


def differences(file: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return a sentence that says what a controller meant otherwise in its training, none where all is the same."""
    changed = [path for path in {**then, **now} if then.get(path) != now.get(path)]
    told = (f"{path} was {then.get(path, 'absent')}, is {now.get(path, 'absent')}" for path in changed)
    return [f"{file}: acts otherwise than it was trained to: {'; '.join(told)}"] if changed else []
