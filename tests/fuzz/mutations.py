"""Damage a scene: its values, types and keys as plain data, or its text."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from cqrun.errors import SceneError
from cqrun.explain import Loc
from cqrun.scene.document import read, write
from cqrun.scene.keypath import value_at
from cqrun.scene.load import load_scene
from cqrun.scene.walk import parts

NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 3, 0.5, -0.0, 1e-3, 7, 64, 1000, 10**6, 10**9, 2**31, 2**53, 2**63, 2**64, 10**30, 10**400,
    1e-12, 1e-30, 1e-100, 1e-320, 1e6, 1e9, 1e12, 1e19, 1e30, 1e39, 1e100, 1e200, 1e308, -1e308,
    float("inf"), float("nan"),
)  # fmt: skip
"""Numbers at the edges of what machines hold, of either sign, and ordinary ones in the wrong place."""

OTHERS: tuple[Any, ...] = (
    None, True, False, "", "~", "all", "auto", "nothing", "..", "/", "a" * 5000, "\x1b[2J", "two\nlines", "$x$",
    "\N{NO-BREAK SPACE}", "\N{MINUS SIGN}1", "\N{FULLWIDTH DIGIT ONE}", "1,5", "0x10", "1e5", "x.y", "*", "[bold]",
    [], {}, [[]], [{}], {"": 1}, {"a": {"a": {}}}, [1], [1, 2], [1, 2, 3], [0.1, 0.1, 0.1, 0.1], ["a"], "\ud83d\ude00",
)  # fmt: skip
"""Values of other types than a field has."""

FRAGMENTS = (
    "\t", "\n", " ", "  ", "- ", ": ", ":", "{", "}", "[", "]", ",", "'", '"', "#", "&a ", "*a ", "!x ", "| ", "> ",
    "?", "%", "@", "`", "<<: ", "---\n", "...\n", "~", "null", "\0", "\x1b", "\x7f", "\x85", "\N{NO-BREAK SPACE}",
    "\N{ZERO WIDTH SPACE}", "\N{ZERO WIDTH NO-BREAK SPACE}", "\N{RIGHT-TO-LEFT OVERRIDE}", "\N{FULLWIDTH COLON}",
    "\N{MINUS SIGN}", "\N{LEFT DOUBLE QUOTATION MARK}", "\N{LINE SEPARATOR}", "0", "9", "e", "-", ".", "\\",
)  # fmt: skip
"""Pieces of text that YAML, terminals or eyes read in a way of their own."""

Damage = Callable[[Any, np.random.Generator], Any]


def mutated(text: str, rng: np.random.Generator) -> str:
    """Return a scene's text with one to three mutations."""
    for _ in range(int(rng.choice([1, 2, 3], p=[0.7, 0.2, 0.1]))):
        text = _once(text, rng)
    return text


def mutated_override(data: Any, rng: np.random.Generator) -> str:
    """Return a `-o key=value` for a scene's plain data: a key path of it, or nearly one, and a value or any text."""
    places = list(_places(data))
    keys = [str(key) for key in _pick(places, rng)]
    for _ in range(int(rng.integers(3))):
        match rng.integers(4):
            case 0:
                keys.insert(
                    int(rng.integers(len(keys) + 1)), str(_pick((*_pick(places, rng), -1, 99, "", "shapes"), rng))
                )
            case 1:
                keys.pop(int(rng.integers(len(keys)))) if len(keys) > 1 else None
            case 2:
                keys = keys[: 1 + int(rng.integers(len(keys)))]
            case _:
                k = int(rng.integers(len(keys)))
                keys[k] = _damaged_text(keys[k], rng)
    value = _pick((*NUMBERS, *OTHERS, value_at(data, _pick(places, rng))), rng)
    text = write(value).strip() if rng.random() < 0.8 else _pick(FRAGMENTS, rng)
    return f"{'.'.join(keys)}{'=' if rng.random() < 0.98 else ''}{text}"


def _once(text: str, rng: np.random.Generator) -> str:
    if rng.random() < 0.12:
        return _damaged_text(text, rng)
    try:
        data = read(text).data
    except SceneError:
        return _damaged_text(text, rng)
    places = list(_places(data))
    if not places:
        return _damaged_text(text, rng)
    kinds: list[Damage] = [_other_value] * 8 + [_without] * 2 + [_doubled, _moved, _extra, _extra, _repeated]
    return write(kinds[rng.integers(len(kinds))](copy.deepcopy(data), rng))


def _places(data: Any, loc: Loc = ()) -> Iterator[Loc]:
    """Yield the place of every key and entry."""
    children = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, child in children:
        yield (*loc, key)
        yield from _places(child, (*loc, key))


def _any_place(data: Any, rng: np.random.Generator) -> tuple[Any, int | str]:
    """Return a random mapping or list, and a key of it."""
    places = list(_places(data))
    loc = places[rng.integers(len(places))]
    return value_at(data, loc[:-1]), loc[-1]


def _pick(values: Any, rng: np.random.Generator) -> Any:
    return values[rng.integers(len(values))]


def _other_value(data: Any, rng: np.random.Generator) -> Any:
    """Return the data with another value at a place; mostly a number for a number."""
    places = [loc for loc in _places(data) if not isinstance(value_at(data, loc), (dict, list))]
    places = places if places and rng.random() < 0.85 else list(_places(data))
    loc = _pick(places, rng)
    holder, key, old = value_at(data, loc[:-1]), loc[-1], value_at(data, loc)
    number = isinstance(old, (int, float)) and not isinstance(old, bool) and abs(old) < 1e100
    if number and rng.random() < 0.75:
        near = (old * 10.0 ** int(rng.integers(-6, 7)), -old, int(old), old * (1 + 1e-9), old + 1, 0.3 * old, 3 * old)
        holder[key] = _pick(NUMBERS, rng) if rng.random() < 0.3 else _pick(near, rng)
    elif isinstance(old, str) and rng.random() < 0.5:
        texts = [str(value_at(data, loc)) for loc in places] + [str(loc[-1]) for loc in places]
        holder[key] = _pick(texts, rng)
    else:
        holder[key] = _pick(OTHERS + NUMBERS, rng)
    return data


def _without(data: Any, rng: np.random.Generator) -> Any:
    """Return the data without a key or an entry."""
    holder, key = _any_place(data, rng)
    del holder[key]
    return data


def _doubled(data: Any, rng: np.random.Generator) -> Any:
    """Return the data with a part also at another place."""
    (source, key), (holder, other) = _any_place(data, rng), _any_place(data, rng)
    holder[other] = copy.deepcopy(source[key])
    return data


def _moved(data: Any, rng: np.random.Generator) -> Any:
    """Return the data with one key renamed."""
    holder, key = _any_place(data, rng)
    names = [str(loc[-1]) for loc in _places(data)]
    if isinstance(holder, dict):
        holder[str(_pick(names + [str(o) for o in OTHERS], rng))] = holder.pop(str(key))
    return data


def _extra(data: Any, rng: np.random.Generator) -> Any:
    """Return the data with a key more: a legal field that the part leaves out, or any."""
    try:
        absent = [
            (loc, name)
            for loc, part in parts(load_scene(copy.deepcopy(data)))
            for name in type(part).model_fields
            if name not in part.model_fields_set
        ]
    except Exception:  # what this raises, the scene itself is judged by
        absent = []
    names = [str(loc[-1]) for loc in _places(data)]
    holder, key = _any_place(data, rng)
    if absent and rng.random() < 0.9:
        loc, key = _pick(absent, rng)
        holder = value_at(data, loc)
    if isinstance(holder, dict):
        holder[str(key)] = _pick((*NUMBERS, *OTHERS, *names, *names), rng)
    return data


def _repeated(data: Any, rng: np.random.Generator) -> Any:
    """Return the data with a list's entries, or a part under other names, many times."""
    holder, key = _any_place(data, rng)
    count = int(_pick((2, 10, 100), rng))
    if isinstance(holder, list):
        holder.extend(copy.deepcopy(holder[int(key)]) for _ in range(count))
    else:
        holder.update({f"{key}_{k}": copy.deepcopy(holder[key]) for k in range(count)})
    return data


def _damaged_text(text: str, rng: np.random.Generator) -> str:
    """Return a text with a piece put in, taken out, repeated or cut off."""
    if not text:
        return _pick(FRAGMENTS, rng)
    begin = int(rng.integers(len(text)))
    end = begin + int(rng.integers(1, 40))
    lines = text.split("\n")
    first, second = (int(rng.integers(len(lines))) for _ in range(2))
    match rng.integers(7):
        case 0:
            return text[:begin] + text[end:]
        case 1:
            return text[:end] + text[begin:]
        case 2:
            return text[:begin]
        case 3:
            lines[first], lines[second] = lines[second], lines[first]
            return "\n".join(lines)
        case 4:
            lines[first] = " " * int(rng.integers(4)) + lines[first].lstrip()
            return "\n".join(lines)
        case _:
            return text[:begin] + _pick(FRAGMENTS, rng) + text[begin:]
