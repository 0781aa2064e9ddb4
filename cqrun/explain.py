"""Error messages in plain words: what is wrong, and what would be right.

Every `Spec` passes pydantic's findings through `reworded`, so scenes, plug-ins and Python calls give the same messages.
The kind of a finding says where its message points: KEY at a key, MISSING at the part that lacks a key, VALUE at a
value.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from typing import Any

from pydantic import ValidationError
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from cqrun.characters import lookalikes, number_meant

KEY, MISSING, VALUE = "cqrun_key", "cqrun_missing", "cqrun_value"

Loc = tuple[int | str, ...]

_TYPES = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "list_type": "a list",
    "dict_type": "a mapping `key: value`",
    "model_type": "a mapping `key: value`",
    "model_attributes_type": "a mapping `key: value`",
    "finite_number": "a finite number",
}
_RANGES = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}


def suggest(name: str, legal: Iterable[str]) -> str:
    """Return ` (did you mean 'x'?)` if a legal name is similar, else an empty string."""
    near = difflib.get_close_matches(str(name), list(legal), n=1)
    return f" (did you mean '{near[0]}'?)" if near else ""


def listed(names: Iterable[str], at_most: int = 20) -> str:
    """Return names joined for a message: `a, b, c`."""
    names = list(names)
    more = f" and {len(names) - at_most} more" if len(names) > at_most else ""
    return ", ".join(names[:at_most]) + more if names else "none"


def shown(value: Any) -> str:
    """Return a value as text for a message, shortened."""
    if isinstance(value, dict):
        return "a mapping"
    if value is None:
        return "empty"
    if isinstance(value, bool):
        return str(value).lower()
    return cut(repr(value))


def cut(text: str) -> str:
    """Return a text cut to 60 characters."""
    return text if len(text) <= 60 else text[:57] + "..."


def finding(message: str, loc: Loc = (), *, kind: str = VALUE, involves: Iterable[str] = ()) -> InitErrorDetails:
    """Return one finding for `complaint`.

    Args:
        message: what is wrong and what would be right.
        loc: keys from the model that raises the error to the place.
        kind: KEY, MISSING or VALUE.
        involves: other keys that may be the cause as well.
    """
    context = {"message": message, "involves": tuple(involves)}
    return InitErrorDetails(type=PydanticCustomError(kind, "{message}", context), loc=loc, input=None)


def complaint(title: str, findings: list[InitErrorDetails]) -> ValidationError:
    """Return the error that a validator raises; pydantic puts the outer keys before each `loc`."""
    return ValidationError.from_exception_data(title, findings)


def merge_alternatives(errors: Iterable[ErrorDetails]) -> Iterator[ErrorDetails]:
    """Yield pydantic's findings, with one instead of two for a field that takes a list or a word.

    Pydantic reports one finding for each alternative and puts the type among the keys: `groups.list[str]`,
    `groups.literal['all']`. The one that fits the given value is yielded, with the field's own key.
    """
    for error in errors:
        field, branch, *inner = (*error["loc"], "", "")[: max(2, len(error["loc"]))]
        if str(branch).startswith("literal["):
            if not isinstance(error["input"], list):
                yield {**error, "loc": (field,), "ctx": {"expected": f"a list, or {error['ctx']['expected']}"}}
        elif not str(branch).startswith("list["):
            yield error
        elif error["type"] != "list_type":
            yield {**error, "loc": (field, *inner)}


def reworded(error: ErrorDetails, prefix: Loc = (), **hints: Any) -> InitErrorDetails:
    """Return pydantic's finding in cqrun's words; a finding that has cqrun's words only gets the prefix."""
    loc, context = (*prefix, *error["loc"]), error.get("ctx", {})
    if error["type"] in (KEY, MISSING, VALUE):
        return finding(context["message"], loc, kind=error["type"], involves=context["involves"])
    kind = {"missing": MISSING, "extra_forbidden": KEY}.get(error["type"], VALUE)
    if loc and loc[-1] == "[key]":
        kind, loc = KEY, loc[:-1]
    return finding(in_words(error, **hints), loc, kind=kind)


def _likely(kind: str, value: Any) -> str:
    """Return what a text of the wrong type was probably meant to be, and the characters that make it a text."""
    if not isinstance(value, str):
        return ""
    strange = list(dict.fromkeys(description for _, description in lookalikes(value)))
    meant = number_meant(value) if kind in ("float_type", "int_type") else None
    hints = [f"it has {listed(strange, 3)}"] * bool(strange) + [f"write {meant}"] * (meant is not None)
    return f": {'; '.join(hints)}" if hints else ""


def in_words(error: ErrorDetails, *, keys: Iterable[str] = (), about: str = "", unit: str | None = None) -> str:
    """Return what is wrong; `keys` are the legal keys, `about` and `unit` describe the field."""
    kind, value, context = error["type"], error["input"], error.get("ctx", {})
    if kind == "missing":
        return f"is missing: {about}" if about else "is missing"
    if kind == "extra_forbidden":
        key = str(error["loc"][-1])
        if key.isdigit() and value is None:  # {dx: 0,02} has the keys dx and 02
            return "is a number after a comma: if the comma is decimal, write a point"
        return f"unknown key{suggest(key, keys)}; keys here: {listed(keys)}"
    if kind in _TYPES:
        in_unit = f" in {unit}" if unit not in (None, "1") and kind == "float_type" else ""
        return f"must be {_TYPES[kind]}{in_unit}, is {shown(value)}{_likely(kind, value)}"
    if kind in _RANGES:
        key, relation = _RANGES[kind]
        return f"must be {relation} {context[key]:g}, is {shown(value)}"
    if kind in ("too_short", "too_long"):
        short = kind == "too_short"
        limit = f"at least {context['min_length']}" if short else f"at most {context['max_length']}"
        entries = "entry" if limit.endswith(" 1") else "entries"
        return f"must have {limit} {entries}, has {context['actual_length']}"
    if kind == "literal_error":
        near = suggest(value, re.findall(r"'([^']*)'", context["expected"])) if isinstance(value, str) else ""
        return f"must be {context['expected']}, is {shown(value)}{near}"
    if kind in ("value_error", "assertion_error"):
        return str(context["error"])
    return f"{error['msg'][:1].lower()}{error['msg'][1:]}, is {shown(value)}"
