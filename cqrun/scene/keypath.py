"""Key paths on plain data: `bodies.beam.material.density`, `world.gravity.2`.

Keys may contain dots (the keys of `unknowns` are paths), so a path is split by the keys that the data have.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

from cqrun.explain import Loc, listed

KEYED_BY_PATHS = {"unknowns", "truth", "overrides"}
"""Mappings whose keys are key paths: the whole rest of a path is one new key."""


NAMED = {
    "bodies", "regions", "boundaries", "rigid", "loads", "forces", "actuators", "observers", "goals", "objective",
    "unknowns", "constraints", "data.recordings", "activation.signals",
}  # fmt: skip
"""Mappings whose keys are names that a user gives: `-o entry=null` removes an entry."""


_OWN = re.compile(r"data\.recordings\.([^.]+)\.overrides\.(.+)", re.DOTALL)


def own_path(recording: str, path: str) -> str:
    """Return the key path of the value that one recording has at a path."""
    return f"data.recordings.{recording}.overrides.{path}"


def split_own(path: str) -> tuple[str, str]:
    """Return the name of the recording that a path made by `own_path` belongs to, and the path in its scene.

    The name is empty for every other path.
    """
    match = _OWN.fullmatch(path)
    return ("", path) if match is None else (match[1], match[2])


def joined(loc: Iterable[int | str]) -> str:
    """Return keys and indices joined to a path."""
    return ".".join(map(str, loc))


def first_key(keys: Iterable[int | str], path: str) -> int | str | None:
    """Return the longest key with which the path begins, or None."""
    matching = [key for key in keys if path == str(key) or path.startswith(f"{key}.")]
    return max(matching, key=lambda key: len(str(key)), default=None)


def locate(data: Any, path: str) -> Loc:
    """Return the keys and indices of a path in plain data; the part that the data lack is split at its dots."""
    loc: list[int | str] = []
    rest = path
    while rest:
        keys: Iterable[int | str] = ()
        if isinstance(data, dict):
            keys = data
        elif isinstance(data, list):
            keys = range(len(data))
        key = first_key(keys, rest)
        if key is not None:
            data = data[key]
        else:
            key = rest if loc and loc[-1] in KEYED_BY_PATHS else rest.partition(".")[0]
            skips = isinstance(data, list) and rest.partition(".")[2].partition(".")[0].isdigit()
            if skips:  # the path is `union.shapes.0`, but the data have the short form `union: [...]`
                rest = rest.partition(".")[2]
                continue
            data = None
        loc.append(key)
        rest = rest[len(str(key)) + 1 :]
    return tuple(loc)


def value_at(data: Any, loc: Loc) -> Any:
    """Return the value at a place in plain data, or None if there is nothing."""
    for key in loc:
        if isinstance(data, dict):
            data = data.get(key)
        else:
            data = data[key] if isinstance(data, list) and isinstance(key, int) and key < len(data) else None
    return data


def replaced(data: Any, loc: Loc, value: Any) -> Any:
    """Return plain data with one value replaced; missing mappings on the way are added.

    Raises:
        KeyError: a list has no such entry; the argument of the error is the message.
    """
    if not loc:
        return value
    key, rest = loc[0], loc[1:]
    if isinstance(data, list):
        if not isinstance(key, int):
            raise KeyError(f"there is no entry '{key}' in a list of {len(data)}; they count from 0")
        return [replaced(item, rest, value) if i == key else item for i, item in enumerate(data)]
    inside = data if isinstance(data, dict) else {}
    return {**inside, key: replaced(inside.get(key), rest, value)}


def is_named(loc: Loc) -> bool:
    """Return whether a place is a named entry, whose name a user gives, or a term of a material."""
    if len(loc) == 4 and loc[0] == "bodies" and loc[2] == "material":
        return loc[3] not in ("density", "elastic")
    if len(loc) == 4 and loc[0] == "bodies" and loc[2] in ("parts", "groups", "material_of"):
        return True
    return joined(loc[:-1]) in NAMED


def removed(data: Any, loc: Loc) -> Any:
    """Return plain data without one entry of a mapping.

    Raises:
        KeyError: there is no such entry; the argument of the error is the message.
    """
    key, rest = loc[0], loc[1:]
    if not isinstance(data, dict) or key not in data:
        existing = listed(data) if isinstance(data, dict) and data else "nothing"
        raise KeyError(f"cannot be removed: there is no '{key}'; there is: {existing}")
    return {**data, key: removed(data[key], rest)} if rest else {k: v for k, v in data.items() if k != key}


def shortest(paths: Sequence[str]) -> list[str]:
    """Return the shortest ends of key paths that are still different: `size.1` and `size.2`, or `youngs_modulus`."""
    keys = [path.split(".") for path in paths]
    out = []
    for own in keys:
        length = 1
        while length < len(own) and (
            own[-length].isdigit() or sum(other[-length:] == own[-length:] for other in keys) > 1
        ):
            length += 1
        out.append(".".join(own[-length:]))
    return out
