"""Numbers and texts that no scene can mean, refused before anything is made of them.

Squares, cubes and quotients of the numbers in a scene must be numbers too, in the engine's precision. So a number is 0
or of a size that no quantity in SI units leaves, and a whole number fits the 64 bits of NumPy and HDF5. A text is a
name, a path or a line for people: control characters would change what a terminal or a file shows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from math import isfinite, log10
from typing import Any

from pydantic_core import InitErrorDetails

from cqrun.characters import controls
from cqrun.explain import KEY, VALUE, Loc, finding, shown

SMALLEST, LARGEST = 1e-100, 1e30
"""Sizes of numbers other than 0. Rounding leaves values such as 1e-17 and their products where 0 is meant."""

LARGEST_WHOLE = 2**63 - 1


def impossible_data(data: Any, loc: Loc = ()) -> Iterator[InitErrorDetails]:
    """Yield every number and text in plain data that no scene can mean; the schema refuses infinity and nan."""
    if isinstance(data, dict):
        for key, value in data.items():
            if isinstance(key, str) and (message := _fault_of_text(key)):
                yield finding(message, (*loc, key), kind=KEY)
            yield from impossible_data(value, (*loc, key))
    elif isinstance(data, (list, tuple)):
        for k, value in enumerate(data):
            yield from impossible_data(value, (*loc, k))
    elif message := _fault_of_number(data) or (_fault_of_text(data) if isinstance(data, str) else ""):
        yield finding(message, loc, kind=VALUE)


def one_line(text: str) -> str:
    """Return a text for people with its line breaks and tabs, and the spaces around them, replaced by a space."""
    return re.sub(r"\s*[\n\r\t]\s*", " ", text).strip() if re.search(r"[\n\r\t]", text) else text


def _fault_of_number(value: Any) -> str:
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
        digits = int(log10(abs(value))) + 1
        return f"is a whole number of about {digits} digits; the largest is 2^63 - 1 = {LARGEST_WHOLE}"
    if isinstance(value, float) and isfinite(value) and value and not SMALLEST <= abs(value) <= LARGEST:
        return f"must be 0, or from {SMALLEST:g} to {LARGEST:g} in size, is {shown(value)}"
    return ""


def _fault_of_text(text: str) -> str:
    for k, character in enumerate(text):
        if controls(character):
            what = "a line break" if character == "\n" else f"the control character U+{ord(character):04X}"
            return f"has {what} as character {k + 1} of {shown(text)}: remove it"
    return ""
